"""Options that say under which payload and temperature a robot works."""

from typing import Annotated

import typer

PayloadKg = Annotated[
    float | None,
    typer.Option(help="Payload of the robot [kg], if the model learned what that does. [default: the usual]"),
]
TemperatureC = Annotated[
    float | None, typer.Option(help="Temperature of the robot [deg C], likewise. [default: the usual]")
]


def given_conditions(payload_kg: float | None, temperature_c: float | None) -> dict[str, float]:
    """The stated conditions, by the names of columns of measurements."""
    stated = {"payload_kg": payload_kg, "temperature_c": temperature_c}
    return {name: value for name, value in stated.items() if value is not None}
