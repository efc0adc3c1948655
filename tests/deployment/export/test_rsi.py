"""RSI configurations state the address, the values and their units."""

from pathlib import Path

import pytest
from lxml import etree
from testing.identified import geometric_model
from testing.refusals import refused

from pisigma.deployment.export.export_format import ExportRequest
from pisigma.deployment.export.registry import export_model
from pisigma.deployment.export.rsi import EXAMPLE, SET_ADDRESS, RsiAddress, rsi_configuration
from pisigma.files.errors import OutputError


@pytest.fixture
def request_of(monkeypatch, tmp_path):
    """A request for a robot of the catalogue."""

    def make(name: str, like: Path | None = None) -> ExportRequest:
        monkeypatch.setattr(ExportRequest, "load", lambda request: geometric_model(name))
        return ExportRequest(tmp_path / "model", tmp_path / "rsi.xml", like=like)

    return make


def test_a_configuration(request_of):
    request = request_of("ur10")
    assert SET_ADDRESS in export_model("rsi", request).remarks
    root = etree.parse(request.out).getroot()
    assert RsiAddress.read(request.out) == EXAMPLE
    sent = [(entry.get("TAG"), entry.get("INDX")) for entry in root.findall("SEND/ELEMENTS/ELEMENT")]
    assert sent == [("DEF_ASPos", "INTERNAL"), ("DEF_Delay", "INTERNAL")]
    received = [tuple(entry.values()) for entry in root.findall("RECEIVE/ELEMENTS/ELEMENT")]
    assert received == [(f"AKorr.A{i}", "DOUBLE", str(i), "1") for i in range(1, 7)]
    said = " ".join(comment.text for comment in root.iter(etree.Comment))
    assert all(word in said for word in ("in degrees", "RSI_ON(#ABSOLUTE)", "'ur10'"))


def test_the_address_of_an_earlier_file(request_of, tmp_path):
    (tmp_path / "old.xml").write_text(rsi_configuration("10.0.0.7", 6001))
    request = request_of("ur10", tmp_path / "old.xml")
    assert SET_ADDRESS not in export_model("rsi", request).remarks
    assert RsiAddress.read(request.out) == RsiAddress("10.0.0.7", 6001, "pisigma")


@pytest.mark.parametrize(
    ("host", "port"), [("robot", 49152), ("192.168.1.10", 0), ("1.2.3.4", 70000), ("", 1)]
)
def test_invalid_addresses_are_refused(host, port, request_of, tmp_path):
    (tmp_path / "old.xml").write_text(rsi_configuration(host, port))
    with refused(OutputError, option="--like", file=tmp_path / "old.xml"):
        export_model("rsi", request_of("ur10", tmp_path / "old.xml"))


def test_other_arms_are_refused(request_of):
    with refused(OutputError, value="kiro3", expected="six revolute joints"):
        export_model("rsi", request_of("kiro3"))


@pytest.mark.parametrize("text", ["", "<ROOT/>", "<ROOT><CONFIG><PORT>1</PORT></CONFIG></ROOT>"])
def test_other_files_are_refused(text, tmp_path):
    (tmp_path / "other.xml").write_text(text)
    with refused(OutputError, file=tmp_path / "other.xml", option="--rsi"):
        RsiAddress.read(tmp_path / "other.xml")
