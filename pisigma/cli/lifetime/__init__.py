"""Commands for a model over the years: recalibrate and monitor."""
