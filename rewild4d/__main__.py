"""`python -m rewild4d` is `rewild4d-bench`."""

from rewild4d.cli import main

main()
