"""``python -m tubesight``: the command line."""

from tubesight.cli.main import main

main()
