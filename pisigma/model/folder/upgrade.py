"""Convert model folders of earlier versions, in which keys of `model.yaml` have other names or forms."""

import hashlib
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safetensors.torch import save as save_tensors

from pisigma.files.errors import ModelError, Place
from pisigma.files.model_files import CARD, COMPILED, DESCRIPTION, MODEL_FILES, WEIGHTS, read_model_file
from pisigma.files.output_folder import staged_folder
from pisigma.files.yaml_file import parse_plain_yaml
from pisigma.joint_correction.gear_lines import GearLines
from pisigma.joint_correction.input_products import InputProducts
from pisigma.measurement.sensors.distance import ANCHOR_COLUMNS
from pisigma.measurement.sensors.socket import SOCKET_COLUMNS
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.folder.model_document import (
    FORMAT,
    document_text,
    read_signed_text,
    stated_format,
    write_document,
)
from pisigma.model.folder.model_folder import load_model, read_weights, write_description
from pisigma.robot.kernels.description_file import read_description

_RENAMED = {
    "dealings": "repeats",
    "doubts": "warnings",
    "factor_on_given_sigma": "factor_on_stated_sigma",
    "gives_up": "limitations",
    "rms_mm_of_dealings": "rms_mm_of_repeats",
    "rms_mm_of_parts": "rms_mm_of_simulations",
    "told_by_the_data": "effective_parameters",
    "unseen": "weak_directions",
    "variance_widening": "prior_scale",
    "widening": "prior_scale",
}
"""New name of every renamed key in the metrics and in the section of the uncertainty."""

_LABELS = (
    (r"^identified; the data hardly .*$", "held by the prior"),
    (r"^identified at the solution, though redundant at the nominal geometry", "only at solution"),
    (r"^without effect on what was measured", "no effect"),
    (r"^too few rows that count show it, the others are outliers", "outliers"),
    (r"^.* is identified, the single values are not", "in a sum"),
    (r"; the data hardly .*$", "; prior"),
)
"""Patterns of remarks of earlier versions on a parameter, and the short labels that newer versions also store."""

_FADED = re.compile(rb"beyond the measured joint values the correction fades to nothing over \d+ deg")
_EXTRAPOLATED = b"beyond the measured joint values the correction is an extrapolation"
"""Pattern of the clause of a card about the fade, and the clause that replaces it."""
_NO_FADE = (
    "The correction now applies at all joint values, with a predicted standard deviation; up to format 3 it faded to "
    "zero outside the measured ones."
)

_KERNELS = "The arrays of the compiled kernels had the form of another version; they were written again."

ROOT = "uncertainty.root"
_MAX_DEVIATIONS = 3.0
"""Number of standard deviations from the mean within which conditions were treated as measured up to format 3."""


@dataclass(frozen=True)
class Upgrade:
    """Result of the upgrade of a model folder.

    Attributes:
        name: name of the model.
        format_before: format of the folder before the upgrade.
        format_after: format after the upgrade; equal to `format_before` if there was nothing to do.
        changes: sentences about differences in the behaviour of the model.
    """

    name: str
    format_before: int
    format_after: int
    changes: tuple[str, ...] = ()


def upgrade_folder(folder: str | os.PathLike[str], check: Callable[[CalibratedModel, Path], None]) -> Upgrade:
    """Convert a model folder of an earlier version to the format of this one, completely or not at all.

    Tensors, figures and all other files are unchanged, except for the type of a covariance root. The card is
    unchanged except for statements that are no longer true. The file for the compiled kernels is rewritten.

    Args:
        folder: folder to upgrade.
        check: function that raises an error if the folder differs from the model in memory, such as
            `pisigma.model.inverse.written_model.check_written`.

    Raises:
        ModelError: the folder is not a model, was truncated or edited, or has a newer format, or the model is a hybrid
            with product units of an earlier version or with an uncertainty whose order cannot be determined.
        OutputError: the folder cannot be written.
    """
    path = Path(folder)
    text = read_signed_text(path / DESCRIPTION)
    before, document = stated_format(text), parse_plain_yaml(text, ModelError, str(path / DESCRIPTION))
    if before is None or not isinstance(document, dict) or not isinstance(document.get("metrics"), dict):
        raise ModelError(
            expected="the description of a model",
            at=Place(path / DESCRIPTION),
            remedy="train or copy the model again",
        )
    if before == FORMAT:
        return _with_new_kernels(path, document, check)
    document["metrics"] = _metrics(str(document.get("kind")), _renamed(document["metrics"]))
    if "uncertainty" in document:
        document["uncertainty"] = _in_order(
            _without_turns(_renamed(document["uncertainty"]), path), document, path
        )
    changes = (*_without_fade(document), *_with_measured_conditions(document))
    others = {entry.name for entry in path.iterdir() if entry.is_file()} - {COMPILED}
    with staged_folder(path, overwrite=True, names=MODEL_FILES | others) as scratch:
        for name in sorted(others):
            (scratch / name).write_bytes(read_model_file(path, name))
        document["weights_sha256"] = _with_exact_root(scratch / WEIGHTS, str(document.get("weights_sha256")))
        if changes and (card := scratch / CARD).is_file():
            card.write_bytes(_FADED.sub(_EXTRAPOLATED, card.read_bytes()))
        text = _text_of(document)
        write_document(text, None, scratch / DESCRIPTION)
        model = load_model(scratch)
        write_description(text, model, scratch)
        check(model, scratch)
    return Upgrade(model.name, before, FORMAT, changes)


def _with_new_kernels(
    path: Path, document: Mapping[str, Any], check: Callable[[CalibratedModel, Path], None]
) -> Upgrade:
    """Rewrite the arrays of the compiled kernels of a folder if this version cannot read them."""
    model, changes = load_model(path), tuple[str, ...]()
    try:
        if (path / COMPILED).is_file():
            read_description(path / COMPILED)
    except ModelError:
        changes = (_KERNELS,)
        others = {entry.name for entry in path.iterdir() if entry.is_file()} - {COMPILED}
        with staged_folder(path, overwrite=True, names=MODEL_FILES | others) as scratch:
            for name in sorted(others):
                (scratch / name).write_bytes(read_model_file(path, name))
            write_description(_text_of(document), model, scratch)
            check(model, scratch)
    return Upgrade(model.name, FORMAT, FORMAT, changes)


def _text_of(document: Mapping[str, Any]) -> str:
    return document_text(
        {key: value for key, value in document.items() if key not in ("format", "compiled_sha256")}
    )


def _without_fade(document: dict[str, Any]) -> tuple[str, ...]:
    """Remove the fade of the correction outside the measured joint values, which formats up to 3 had.

    Returns:
        A sentence about the change if the folder had a fade.
    """
    document.get("uncertainty", {}).pop("unexplained_m", None)
    learned = (document["metrics"].get("hybrid") or {}).get("learned") or {}
    learned.pop("fades_over_deg", None)
    return () if document.get("learned", {}).pop("fade_rad", None) is None else (_NO_FADE,)


def _without_turns(uncertainty: dict[str, Any], path: Path) -> dict[str, Any]:
    """Replace the list of product-unit factors of formats up to 3 with the statement that there are no input products.

    Raises:
        ModelError: there are factors of product units; their uncertainty cannot be converted to an uncertainty of
            products.
    """
    if uncertainty.pop("turns", []):
        raise ModelError(
            "the uncertainty of product units of an earlier version cannot be converted",
            expected="a joint correction without product units",
            at=Place(path),
            remedy="calibrate again",
        )
    return {"products": False, **uncertainty}


def _in_order(uncertainty: dict[str, Any], document: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """Add the order of the root's rows, which folders up to format 4 do not state.

    The weights are in the order in which the calibration tried the features: products of inputs after all others,
    except for gear lines, which were fitted last, to the residuals of all other features. Unknown sensor parameters are
    in the order of their values.

    Raises:
        ModelError: rows were added to a model whose weights were read in another order.
    """
    features = [feature["name"] for feature in document.get("learned", {}).get("features", ())]
    if uncertainty.pop("products"):
        if GearLines.name in features and document.get("kind") != "hybrid_calibration":
            raise ModelError(
                "an earlier version recalibrated products and gear lines with weights in the wrong order, so the "
                "model itself is wrong",
                expected="an uncertainty whose weights are in a known order",
                at=Place(path),
                remedy="calibrate again, or upgrade the original calibration and recalibrate that",
            )
        features.insert(
            features.index(GearLines.name) if GearLines.name in features else len(features),
            InputProducts.name,
        )
    groups = [
        {
            "name": name,
            "columns": list(columns),
            "owners": uncertainty.pop(f"{name}s"),
            "angles": [],
            "units": {},
        }
        for name, columns in (("socket", SOCKET_COLUMNS), ("anchor", ANCHOR_COLUMNS))
    ]
    groups += [{"name": name, **group} for name, group in uncertainty.pop("others", {}).items()]
    order = list(uncertainty.get("values", {}))
    groups.sort(key=lambda group: order.index(group["name"]) if group["name"] in order else len(order))
    return {
        "unknowns": [group for group in groups if group["owners"]],
        **uncertainty,
        "features": features,
    }


def _with_exact_root(path: Path, sha256: str) -> str:
    """Convert the covariance root (float32 up to format 4) to float64, and return the new hash of the file.

    Raises:
        ModelError: the hash of the file differs from the one in the description.
    """
    tensors = read_weights(path, sha256)
    if ROOT in tensors:
        tensors[ROOT] = tensors[ROOT].double()
        path.write_bytes(save_tensors(tensors))
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _with_measured_conditions(document: Mapping[str, Any]) -> tuple[str, ...]:
    """Estimate the measured ranges of payload and temperature, which formats up to 3 lack, from mean and spread."""
    for feature in document.get("learned", {}).get("features", ()):
        if feature["name"] == "conditions" and "measured" not in feature:
            spans = zip(feature["names"], feature["mean"], feature["spread"], strict=True)
            feature["measured"] = [
                [max(low, 0.0) if name == "payload_kg" else low, mean + _MAX_DEVIATIONS * spread]
                for name, mean, spread in spans
                for low in [mean - _MAX_DEVIATIONS * spread]
            ]
            named = " and ".join(
                f"{name} {low:.4g} to {high:.4g}"
                for name, (low, high) in zip(feature["names"], feature["measured"], strict=True)
            )
            return (
                f"The folder does not state which conditions were measured; {named} are assumed, three standard "
                "deviations to either side of the mean. Calibrate again to store the measured ones.",
            )
    return ()


def _renamed(values: Any) -> Any:
    """Return the values with the keys of the current format."""
    if isinstance(values, dict):
        return {_RENAMED.get(key, key): _renamed(value) for key, value in values.items()}
    return [_renamed(value) for value in values] if isinstance(values, list) else values


def _metrics(kind: str, metrics: dict[str, Any]) -> dict[str, Any]:
    """Return metrics in the current form; see `pisigma.validation.held_out`."""
    if kind == "distilled":
        return metrics | {"joints": [_joint(joint) for joint in metrics.get("joints", ())]}
    if kind not in ("geometric_calibration", "hybrid_calibration"):
        return metrics
    if "parameters" not in metrics:  # studies stored different figures, which are not read
        return {}
    metrics = metrics | {"parameters": [_labelled(row) for row in metrics["parameters"]]}
    held_out = metrics.get("held_out")
    if isinstance(held_out, Mapping) and "rms_mm" in held_out:
        errors = {key: value for key, value in held_out.items() if key != "rows"}
        metrics["held_out"] = {"rows": held_out["rows"], "geometric": errors}
    return metrics


def _labelled(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return a row of the parameter table with a label."""
    label = row["remark"]
    for pattern, words in _LABELS:
        label = re.sub(pattern, words, label)
    return {**row, "label": label}


def _joint(joint: Mapping[str, Any]) -> dict[str, Any]:
    """Return the figures of a joint of a distilled model with names without units."""
    if "correction" in joint:
        return dict(joint)
    names: Sequence[str] = ("mean", "rms", "max")
    parts = {
        part: {name: joint[f"{part}_{name}_{joint['unit']}"] for name in names}
        for part in ("correction", "error")
    }
    return {"name": joint["name"], "unit": joint["unit"], **parts}
