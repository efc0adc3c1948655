"""Settings of the steps of the workflow; they do not import torch, so that commands start quickly."""
