"""Sentences and cards from templates."""

from pisigma.files.model_files import CARD
from pisigma.reporting.rendering import render_sentences, write_card
from pisigma.validation.held_out.calibration_summary import NoiseFigures, OutlierFigures


def outlier(row):
    return OutlierFigures(row=row, place=f"a.csv, line {row}", sensor="position", residual_in_sigmas=9.0)


def test_paragraphs_of_a_macro_are_sentences_of_their_own():
    direction, first = render_sentences("report.txt.j2", "weak_parameters", ["a + b is weak."], ["c_1"], "2")
    assert "a + b is weak." in direction
    assert first.startswith("c_1:")
    assert direction.endswith(".")
    assert first.endswith(".")


def test_a_macro_may_be_empty():
    assert render_sentences("report.txt.j2", "outliers", []) == ()
    (text,) = render_sentences("report.txt.j2", "outliers", [outlier(row) for row in range(2, 7)])
    assert text.startswith("5 ")
    assert text.endswith("(a.csv, line 2, a.csv, line 3, a.csv, line 4).")


def test_noise_is_stated_in_the_unit_of_its_sensor():
    stated = NoiseFigures(
        sensor="position", value_count=9, used_by_parameters=1.0, factor_on_stated_sigma=1.5
    )
    turning = NoiseFigures(sensor="rotation", value_count=9, used_by_parameters=1.0, sigma_deg=0.01)
    assert "1.5 times" in render_sentences("calibration.txt.j2", "noise", stated)[0]
    assert "0.01 deg" in render_sentences("calibration.txt.j2", "noise", turning)[0]


def test_a_card_ends_with_a_line(tmp_path):
    write_card(tmp_path, "card.md.j2")
    assert (tmp_path / CARD).read_text().endswith("\n")
