"""Model folders of earlier versions made new: keys of `model.yaml` that have another name or form since."""

import hashlib
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safetensors.torch import save as save_tensors

from pisigma.files.errors import ModelError
from pisigma.files.model_files import CARD, COMPILED, DESCRIPTION, MODEL_FILES, WEIGHTS, read_model_file
from pisigma.files.output_folder import staged_folder
from pisigma.files.yaml_file import plain_content
from pisigma.joint_correction.gear_lines import GearLines
from pisigma.joint_correction.input_products import InputProducts
from pisigma.measurement.sensors.anchor import ANCHOR_COLUMNS
from pisigma.measurement.sensors.socket import SOCKET_COLUMNS
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.folder.model_document import (
    FORMAT,
    document_text,
    read_signed_text,
    stated_format,
    write_document,
)
from pisigma.model.folder.model_folder import describe, load_model, read_weights

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
"""Old and new names of keys, wherever they stand among metrics and in the section of the uncertainty."""

_LABELS = (
    (r"^identified; the data hardly .*$", "held by the prior"),
    (r"^identified at the solution, though redundant at the nominal geometry", "only at solution"),
    (r"^without effect on what was measured", "no effect"),
    (r"^too few rows that count show it, the others are outliers", "outliers"),
    (r"^.* is identified, the single values are not", "in a sum"),
    (r"; the data hardly .*$", "; prior"),
)
"""What earlier versions said of a parameter, and the few words for it that newer ones keep beside."""

_FADED = re.compile(rb"beyond the measured joint values the correction fades to nothing over \d+ deg")
_EXTRAPOLATED = b"beyond the measured joint values the correction is an extrapolation"
"""What a card said of the fade, and what it says instead."""
_NO_FADE = (
    "The correction now holds at all joint values, and the predicted deviation says how well; up to format 3 it faded "
    "to the geometric calibration beyond the measured ones."
)

ROOT = "uncertainty.root"
MOST_SPREADS = 3.0
"""Up to format 3 conditions counted as measured so many standard deviations from their mean."""


@dataclass(frozen=True)
class Upgrade:
    """A folder that was made new.

    Attributes:
        name: of the model.
        before: format that the folder had.
        after: format that it has now; the same where there was nothing to do.
        changes: sentences on what the model does otherwise than before.
    """

    name: str
    before: int
    after: int
    changes: tuple[str, ...] = ()


def upgrade_folder(folder: str | os.PathLike[str], check: Callable[[CalibratedModel, Path], None]) -> Upgrade:
    """Rewrite a model folder of an earlier version in the form of this one, whole or not at all.

    Tensors, figures and all other files stay as they are, but for the type of the root of a covariance, and so does the
    card but for what is not true any more; the file for the compiled kernels is made again.

    Args:
        folder: to upgrade.
        check: raises where a folder does not say what a model in memory says: `pisigma.model.inverse.written_model`.

    Raises:
        ModelError: the folder holds no model, it is truncated, was edited or is of a newer format, or it is a hybrid
            with product units of an earlier version, or with an uncertainty whose order cannot be known.
        OutputError: the folder cannot be written.
    """
    path = Path(folder)
    text = read_signed_text(path / DESCRIPTION)
    before, document = stated_format(text), plain_content(text, ModelError, str(path / DESCRIPTION))
    if before is None or not isinstance(document, dict) or not isinstance(document.get("metrics"), dict):
        raise ModelError(f"{path / DESCRIPTION}: does not describe a model; train or copy the model again.")
    if before == FORMAT:
        return Upgrade(load_model(path).name, before, FORMAT)
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
        text = document_text(
            {key: value for key, value in document.items() if key not in ("format", "compiled_sha256")}
        )
        write_document(text, None, scratch / DESCRIPTION)
        model = load_model(scratch)
        describe(text, model, scratch)
        check(model, scratch)
    return Upgrade(model.name, before, FORMAT, changes)


def _without_fade(document: dict[str, Any]) -> tuple[str, ...]:
    """Take out how a correction faded to the geometric calibration, as it did up to format 3; says so where it did."""
    document.get("uncertainty", {}).pop("unexplained_m", None)
    learned = (document["metrics"].get("hybrid") or {}).get("learned") or {}
    learned.pop("fades_over_deg", None)
    return () if document.get("learned", {}).pop("fade_rad", None) is None else (_NO_FADE,)


def _without_turns(uncertainty: dict[str, Any], path: Path) -> dict[str, Any]:
    """Say that there are no products of inputs, where up to format 3 the factors of product units were named.

    Raises:
        ModelError: there are such factors, whose uncertainty is not that of products.
    """
    if uncertainty.pop("turns", []):
        raise ModelError(
            f"{path}: a joint correction without product units was wanted, but this one has them from an earlier "
            "version, whose uncertainty cannot be converted; calibrate again."
        )
    return {"products": False, **uncertainty}


def _in_order(uncertainty: dict[str, Any], document: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """State the order of the root's rows, which folders up to format 4 do not.

    Their weights are in the order in which the calibration tried the features: products of inputs behind all others,
    but for single lines, which were looked for in what all others leave. Sensors' unknowns are in the order of their
    values.

    Raises:
        ModelError: rows were added to a model whose weights were read in another order.
    """
    features = [feature["name"] for feature in document.get("learned", {}).get("features", ())]
    if uncertainty.pop("products"):
        if GearLines.name in features and document.get("kind") != "hybrid_calibration":
            raise ModelError(
                f"{path}: expected an uncertainty whose weights are in a known order, got one of products and lines to "
                "which an earlier version added rows in another order, so that the model itself is wrong; calibrate "
                "again, or upgrade the calibration and recalibrate that again."
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
    """Write the root of the covariance in float64, which is in float32 up to format 4; gives the new hash of the file.

    Raises:
        ModelError: the file is not the one that the description states.
    """
    tensors = read_weights(path, sha256)
    if ROOT in tensors:
        tensors[ROOT] = tensors[ROOT].double()
        path.write_bytes(save_tensors(tensors))
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _with_measured_conditions(document: Mapping[str, Any]) -> tuple[str, ...]:
    """State the measured payloads and temperatures, which folders up to format 3 lack: about their means."""
    for feature in document.get("learned", {}).get("features", ()):
        if feature["name"] == "conditions" and "measured" not in feature:
            spans = zip(feature["names"], feature["mean"], feature["spread"], strict=True)
            feature["measured"] = [
                [max(low, 0.0) if name == "payload_kg" else low, mean + MOST_SPREADS * spread]
                for name, mean, spread in spans
                for low in [mean - MOST_SPREADS * spread]
            ]
            named = " and ".join(
                f"{name} {low:.4g} to {high:.4g}"
                for name, (low, high) in zip(feature["names"], feature["measured"], strict=True)
            )
            return (
                f"The folder does not say which conditions were measured; {named} are taken, three standard "
                "deviations to either side of the mean. Calibrate again to keep the measured ones.",
            )
    return ()


def _renamed(values: Any) -> Any:
    """The same values with the keys of today."""
    if isinstance(values, dict):
        return {_RENAMED.get(key, key): _renamed(value) for key, value in values.items()}
    return [_renamed(value) for value in values] if isinstance(values, list) else values


def _metrics(kind: str, metrics: dict[str, Any]) -> dict[str, Any]:
    """Metrics in the form of today; see `pisigma.validation.held_out`."""
    if kind == "distilled":
        return metrics | {"joints": [_joint(joint) for joint in metrics.get("joints", ())]}
    if kind not in ("geometric_calibration", "hybrid_calibration"):
        return metrics
    if "parameters" not in metrics:  # of a study that kept other figures, which nothing reads
        return {}
    metrics = metrics | {"parameters": [_labelled(row) for row in metrics["parameters"]]}
    held_out = metrics.get("held_out")
    if isinstance(held_out, Mapping) and "rms_mm" in held_out:
        errors = {key: value for key, value in held_out.items() if key != "rows"}
        metrics["held_out"] = {"rows": held_out["rows"], "geometric": errors}
    return metrics


def _labelled(row: Mapping[str, Any]) -> dict[str, Any]:
    """A row of the parameter table with its label."""
    label = row["remark"]
    for pattern, words in _LABELS:
        label = re.sub(pattern, words, label)
    return {**row, "label": label}


def _joint(joint: Mapping[str, Any]) -> dict[str, Any]:
    """Corrections of a joint of a distilled model, and their errors, without units in the names."""
    if "correction" in joint:
        return dict(joint)
    names: Sequence[str] = ("mean", "rms", "max")
    parts = {
        part: {name: joint[f"{part}_{name}_{joint['unit']}"] for name in names}
        for part in ("correction", "error")
    }
    return {"name": joint["name"], "unit": joint["unit"], **parts}
