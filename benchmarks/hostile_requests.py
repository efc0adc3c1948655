"""Random requests to the page of a cell that must be refused or must not change anything."""

import json
import random
import re

HOSTILE = (
    "",
    "\0",
    "../../etc/passwd",
    "<script>alert(1)</script>",
    "nan",
    "-1e308",
    "9" * 400,
    "é\u202e",
    "'; DROP TABLE x",
    "{}",
)
FUZZED = {
    "plan": "count",
    "calibrate": "folds",
    "verify": "of_model",
    "monitor": "seed",
    "recalibrate": "draws",
    "measure": "session",
    "session": "session",
    "event": "kind",
    "use": "model",
    "export": "format",
    "ik": "x_mm",
    "cell": "seen",
    "controller": "export",
    "import": "files",
}
"""Steps, each with a field in which a hostile value has to be refused."""


def hostile_request(chosen: random.Random) -> tuple[str, str, str]:
    """Return path, method and body of a request that must be refused or must not change anything."""
    value, kind = chosen.choice(HOSTILE), chosen.randrange(6)
    if kind == 0:
        body = "".join(chosen.choices("q1_deg,x_mm;\t\n0123456789.-\"'eE\0", k=chosen.randrange(400)))
        return "upload?name=" + re.sub(r"[^a-z.%0-9]", "%2f", value)[:50], "POST", body
    if kind == 1:
        return (
            chosen.choice(("propose", "check")),
            "POST",
            json.dumps(
                {
                    "files": str(chosen.randrange(40)),
                    "unit": value,
                    "new_frame_at": value,
                    "column 0 0": value,
                }
            ),
        )
    if kind == 2:
        step, field = chosen.choice([*FUZZED.items()])
        return f"step/{step}?person=x", "POST", json.dumps({field: value or "?", "command": value})
    if kind == 3:
        return (
            chosen.choice(("show", "drag", "stop", "step/plan", "propose")),
            "POST",
            chosen.choice(("", "{", "[]", '{"a": 1}', '"x"', "nul")),
        )
    if kind == 4:
        return "show", "POST", json.dumps({"text": f"line {value} lines 1 to 99999999 {value}.csv"})
    folder, way = (
        chosen.choice(("plan", "model", "export", "report", "x")),
        chosen.choice(("..%2f", "%2e%2e/", "")),
    )
    return f"download/{folder}/{way}cell.yaml", "GET", ""
