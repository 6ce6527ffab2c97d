"""python -m mastd3r"""

import sys

from .cli.main import main

sys.exit(main())
