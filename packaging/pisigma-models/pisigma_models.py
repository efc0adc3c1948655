"""Trained models of pisigma: `pisigma.load(pisigma_models.FOLDER / "ur10_landgraf")`."""

from pathlib import Path

FOLDER = Path(__file__).parent
"""Folder of the model folders; its README.md cites the data."""
