"""The site: what its hooks make of a page."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

pytest.importorskip("mkdocs")
pytest.importorskip("nbconvert")
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))

from site_pages import whole_options


def test_an_option_in_a_line_of_text_is_kept_whole_and_a_block_of_code_is_left_alone():
    whole = '<code>predict DIR <span class="option">--out</span> NEXT <span class="option">-n</span> 0</code>'
    assert whole_options("<p><code>predict DIR --out NEXT -n 0</code></p>") == f"<p>{whole}</p>"
    for left in ("<pre><code>predict --out NEXT</code></pre>", "<p>--out</p>", "<code>a-b, own--made</code>"):
        assert whole_options(left) == left
