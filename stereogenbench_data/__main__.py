"""``python -m stereogenbench_data``: the command ``stereogenbench``."""

from stereogenbench_data.cli.main import main

if __name__ == "__main__":
    main()
