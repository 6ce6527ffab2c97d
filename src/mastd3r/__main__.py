"""python -m mastd3r"""

import sys

from .cli import main

sys.exit(main())
