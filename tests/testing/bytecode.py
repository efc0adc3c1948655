"""Let the workers of pytest store bytecode, whatever their process was told.

Otherwise every worker compiles all tests and all of pisigma in every run, which is half of the time of collecting.
"""

import sys

sys.dont_write_bytecode = False
