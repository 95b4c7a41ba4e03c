"""``python -m tubesight``: the command line, where no script is installed."""

from tubesight.cli.main import main

main()
