"""Run the README's section "First batch" as a reader would, with the package that is installed.

python .ci/first_lines.py README.md, in an empty folder outside the repository.
"""

import re
import shlex
import subprocess
import sys
from pathlib import Path


def main() -> None:
    """Run the commands and the Python of the section in their order; an error ends this program."""
    text = Path(sys.argv[1]).read_text()
    section = re.split(r"^## ", text.partition("\n## First batch\n")[2], flags=re.MULTILINE)[0]
    blocks = re.findall(r"```(\w*)\n(.*?)```", section, flags=re.DOTALL)
    programs = Path(sys.executable).parent
    for language, block in blocks:
        if language == "python":
            Path("first_batch.py").write_text(block)
            subprocess.run([sys.executable, "first_batch.py"], check=True)
        for words in (shlex.split(line, comments=True) for line in block.splitlines()):
            # `browse` serves until Ctrl-C.
            if words[:1] == ["stereogenbench"] and words[1] != "browse":
                subprocess.run([programs / words[0], *words[1:]], check=True)
    if {language for language, _ in blocks} != {"", "python"}:
        raise SystemExit(f"{sys.argv[1]}: the section First batch has no commands or no Python")


if __name__ == "__main__":
    main()
