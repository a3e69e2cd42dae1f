"""Docstrings, comments, messages and documents are understood at the first reading.

Turns of phrase that make readers read twice are counted per 1,000 words. Limits are two to five times the rates of sbi,
blackjax and diffrax. docs/glossary.md has the terms to use.
"""

from __future__ import annotations

import json
import re
from functools import cache
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
PACKAGE = REPOSITORY / "rfdropo_bayes"
ROOMS = sorted(path.name for path in PACKAGE.iterdir() if path.is_dir() and any(path.glob("*.py")))
TOP = "top level"

KINDS = {  # kind: pattern, limit per 1,000 words, remedy
    "what": (r"(?i)\bwhat\b(?![:=`]| =)(?![^.;|]*\?)", 1.2, "name the quantity; 'what' is for questions"),
    "where": (r"(?i)\bwhere\b(?![:=`]| =)(?![^.;|]*\?)", 1.6, "'if' or 'when', unless it is a place"),
    "one": (
        r"(?i)\b(?:the|this|that|an?|each|every|any|other|another|same|last|first|best|new|old|\w+er)\s+ones?\b"
        r"(?!\s+(?:of|or|row|cable|day))|\bones\b|\bone's\b",
        1.0,
        "repeat the noun",
    ),
    "that of, those": (r"(?i)\b(?:that|those) of\b|\bthose\b", 0.8, "repeat the noun"),
    "fronted": (r"(?m)(?:^|[.:;] )(?:Of|Beside|Besides|Among|Beyond) ", 0.15, "subject first"),
    "say, tell": (
        r"(?i)\b(?:tell|tells|told|say|says|said) (?:of|apart|what|which|how|where|so)\b",
        0.2,
        "the verb of the field",
    ),
    "so many": (r"(?i)\bso many\b|\blikewise\b|\balike\b|\bas many\b", 0.4, "the number or the name"),
    "too": (r"(?i), too\b", 0.2, "'also' before the verb"),
    "metaphor": (
        r"(?i)(?<![`_])\b(?:climb(?:s|ed|ing)?|summits?|far off|rivals?|judged|judges|judging)\b(?![`:(_])",
        0.4,
        "the term of docs/glossary.md",
    ),
}
LONG, LONG_SHARE = 32, 0.01  # words of a long sentence; largest share of long sentences (25 words are the aim)
SENTENCE = re.compile(r"[.:;!?](?=\s|$|\")|\n\s*\n|\n\s*[-*] |\|")
STRING = re.compile(
    r'"""(?P<documented>.*?)"""|"(?P<message>(?:[^"\\\n]|\\.)*)"|\'(?:[^\'\\\n]|\\.)*\'|#(?P<comment>[^\n]*)', re.DOTALL
)
LEAST = 200  # words of a text with a rate


def count_words(text: str) -> int:
    return len(re.findall(r"[A-Za-z]+", text))


@cache
def written(room: str) -> dict[str, str]:
    """Docstrings, comments and longer other strings (messages and help) of a room, by a scan without a syntax tree."""
    found: dict[str, list[str]] = {"documented": [], "message": [], "comment": []}
    for path in sorted(PACKAGE.glob("*.py") if room == TOP else (PACKAGE / room).rglob("*.py")):
        for match in STRING.finditer(path.read_text(encoding="utf-8")):
            if match.lastgroup is not None:
                found[match.lastgroup].append(match[match.lastgroup])
    messages = [re.sub(r"\{[^{}]*\}", "", text) for text in found["message"]]
    found["message"] = [text for text in messages if count_words(text) > 4]
    return {kind: "\n\n".join(texts) for kind, texts in found.items()}


def faults(text: str) -> list[str]:
    """One line per kind over its limit, with some of its places."""
    count, found = count_words(text), []
    if count < LEAST:
        return []
    for name, (pattern, limit, remedy) in KINDS.items():
        places = [text[max(0, m.start() - 40) : m.end() + 30].replace("\n", " ") for m in re.finditer(pattern, text)]
        if 1e3 * len(places) > max(limit * count, 1e3):
            found.append(f"{name}: {len(places)} in {count} words, at most {limit} per 1,000; {remedy}: {places[:5]}")
    sentences = SENTENCE.split(text)
    longest = [sentence for sentence in sentences if count_words(sentence) > LONG]
    if len(longest) > max(LONG_SHARE * len(sentences), 1):
        found.append(f"{len(longest)} sentences of more than {LONG} words, such as {longest[0][:200]!r}")
    return found


@pytest.mark.parametrize("kind", ["documented", "message", "comment"])
@pytest.mark.parametrize("room", [TOP, *ROOMS])
def test_the_words_of_a_room_are_plain(room: str, kind: str) -> None:
    assert faults(written(room)[kind]) == []


def test_pages_of_results_are_plain() -> None:
    """Text of the templates of reports, without tags and expressions."""
    text = "\n".join(path.read_text(encoding="utf-8") for path in sorted(PACKAGE.glob("report/templates/*.j2")))
    text = re.sub(r"\{%.*?%\}|\{\{.*?\}\}|<(script|style).*?</\1>", "", text, flags=re.DOTALL)
    assert faults(re.sub(r"<[^>]*>", "|", text)) == []


@pytest.mark.parametrize("path", sorted(REPOSITORY.glob("notebooks/*.ipynb")), ids=lambda path: path.stem)
def test_notebooks_are_plain(path: Path) -> None:
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    text = "\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")
    assert faults(re.sub(r"`[^`]*`", "", text)) == []


def test_documents_are_plain() -> None:
    pages = [REPOSITORY / "README.md", REPOSITORY / "CONTRIBUTING.md", *sorted((REPOSITORY / "docs").rglob("*.md"))]
    text = "\n".join(page.read_text(encoding="utf-8") for page in pages)
    assert faults(re.sub(r"```.*?```|`[^`]*`|\]\([^)]*\)", "", text, flags=re.DOTALL)) == []


def test_reports_are_plain() -> None:
    folders = ("reports", "examples", "models")
    pages = [page for folder in folders for page in sorted((REPOSITORY / folder).rglob("README.md"))]
    text = "\n\n".join(page.read_text(encoding="utf-8") for page in pages)
    assert faults(re.sub(r"```.*?```|`[^`]*`|\]\([^)]*\)", "", text, flags=re.DOTALL)) == []


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ("What the model leaves of every recording.", "what"),
        ("None where no port is significant.", "where"),
        ("A coordinate without one stays, as the other one does.", "one"),
        ("The errors are those of the data.", "that of, those"),
        ("Of row 0 the angles are read.", "fronted"),
        ("It says how to go on.", "say, tell"),
        ("The value after so many steps.", "so many"),
        ("It is read, too.", "too"),
        ("The climb ends on a summit.", "metaphor"),
    ],
)
def test_each_turn_of_phrase_is_seen(text: str, kind: str) -> None:
    plain = "The residuals of every recording are read as well. " * 30
    assert faults(plain) == []
    (found,) = faults(plain + "\n" + f"{text}\n" * 2)
    assert found.startswith(f"{kind}: ")


def test_questions_and_names_are_no_faults() -> None:
    plain = "The residuals of every recording are read as well. " * 30
    assert faults(plain + "What is missing? Where does it act? what: the fault. where: its place. " * 4) == []
