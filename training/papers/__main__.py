"""`python training/papers`: make the page of the recipes again, or run one of them and store its result."""

import sys

from command import main

sys.exit(main())
