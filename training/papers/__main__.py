"""`python training/papers`: generate the page of the recipes, or run one of them and store its result."""

import sys

from command import main

sys.exit(main())
