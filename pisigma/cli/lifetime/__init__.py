"""Commands for a model over the years: recalibrate, monitor and compare."""
