"""The steps of a calibration as functions: typed settings in, typed results out."""
