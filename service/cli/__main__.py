"""`python -m service.cli`: the commands of `lalaloc-service`."""

import sys

from service.cli.entry_point import main

if __name__ == "__main__":
    sys.exit(main())
