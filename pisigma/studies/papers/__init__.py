"""The papers side by side: `training/README.md` and its figures, made of stored results of the recipes."""
