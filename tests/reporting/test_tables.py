"""Figures as text."""

import pytest

from pisigma.reporting.tables import joint_table, number_text, pose_table
from pisigma.validation.held_out.training_summary import JointFigures
from pisigma.validation.held_out.validation_figures import ErrorFigures

JOINTS = [
    {
        "name": "theta_1",
        "training": {
            "before": {"average_deg": 0.475, "deviation_deg": 0.3179, "maximum_deg": 1.2758},
            "after": {"average_deg": 1.5e-4, "deviation_deg": 0.0, "maximum_deg": 12.5},
        },
    },
    {
        "name": "d_3",
        "held_out": {
            "before": {"average_mm": 1.0, "deviation_mm": 2.0, "maximum_mm": 3.0},
            "after": {"average_mm": 0.1, "deviation_mm": 0.2, "maximum_mm": 0.3},
        },
    },
]


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "0.0000"), (1.23456, "1.2346"), (0.001, "0.0010"), (0.00012, "1.2e-04"), (-2e-5, "-2.0e-05")],
)
def test_small_figures_keep_two_digits(value, text):
    assert number_text(value) == text


def test_joint_table_has_a_line_per_joint_and_part_with_its_unit():
    head, rule, *lines = joint_table([JointFigures.model_validate(joint) for joint in JOINTS]).splitlines()
    assert head.count("|") == rule.count("|") == 10
    assert lines == [
        "| theta_1 | deg | training | 0.4750 | 0.3179 | 1.2758 | 1.5e-04 | 0.0000 | 12.5000 |",
        "| d_3 | mm | held-out | 1.0000 | 2.0000 | 3.0000 | 0.1000 | 0.2000 | 0.3000 |",
    ]


def test_pose_table_has_a_column_per_model():
    table = pose_table(
        {"nominal": ErrorFigures(rms_mm=2.0, p95_deg=3.0), "corrected": ErrorFigures(rms_mm=0.5, p95_deg=0.1)}
    )
    assert table.splitlines() == [
        "| error | unit | nominal | corrected |",
        "| --- | --- | --- | --- |",
        "| position, RMS | mm | 2.0000 | 0.5000 |",
        "| orientation, 95 % | deg | 3.0000 | 0.1000 |",
    ]
