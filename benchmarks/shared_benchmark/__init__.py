"""A benchmark of kinematic calibration on public measurements of real arms, see `benchmarks/benchmark.py`.

A series is one file in `series/`, a method is one file in `methods/`. Every fit runs in a process of its own, whose
Python may be another one, so methods see numpy arrays only.
"""
