"""Run the examples and write docs/gallery.md of them: question, picture, what it shows, the last line printed.

    python tools/gallery.py [NAME ...]

Without names all of them, in the order of examples/README.md; the page keeps what the others printed before.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
PAGE, PICTURES, PRINTED = ROOT / "docs" / "gallery.md", ROOT / "docs" / "images" / "gallery", "printed.json"
ROW = re.compile(r"^\| \[(\w+)\.py\]\(\w+\.py\) \| (.*?) \| (.*?) \|$", re.MULTILINE)
COLOURS = 128  # of a picture: a third of the size, and no difference to be seen
HEAD = """# Gallery

One question each, answered by at most 60 lines of Python. Each example checks its own number. `make notebooks` runs all
of them, `make gallery` draws this page.
"""


def run(name: str) -> str:
    """Run an example, keep its picture, and return the last line that it printed."""
    picture = PICTURES / f"{name}.png"
    command = [sys.executable, str(ROOT / "examples" / f"{name}.py"), str(picture)]
    printed = subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True).stdout
    with Image.open(picture) as drawn:
        drawn.convert("RGB").quantize(COLOURS).save(picture, optimize=True)
    return printed.strip().splitlines()[-1]


def section(name: str, question: str, shown: str, printed: str) -> str:
    """An example as a part of the page."""
    return f"""
## {question}

![Output of {name}](images/gallery/{name}.png)

{shown}

It prints: {printed}

[{name}.py](../examples/{name}.py)
"""


def main(names: list[str]) -> None:
    """Run what is asked for, and write the page."""
    listed = ROW.findall((ROOT / "examples" / "README.md").read_text(encoding="utf-8"))
    PICTURES.mkdir(parents=True, exist_ok=True)
    store = PICTURES / PRINTED
    printed = json.loads(store.read_text(encoding="utf-8")) if store.exists() else {}
    for name, question, _ in listed:
        if "(needs " in question:
            continue
        if name in names or not names:
            print(name, flush=True)
            printed[name] = run(name)
    store.write_text(json.dumps(printed, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    parts = [section(name, question, shown, printed[name]) for name, question, shown in listed if name in printed]
    PAGE.write_text(HEAD + "".join(parts), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
