"""Electronic data sheets (EDS) of drives; the simulated drive's sheet has any requested number of axes."""

from __future__ import annotations

import io
import re
from pathlib import Path

import canopen
from canopen.objectdictionary.eds import import_eds

from rfdropo_bayes.deployment import objects
from rfdropo_bayes.errors import InputError

EDS_REMEDY = "give the data sheet that came with this drive"
_PDO = (0x1400, 0x1600, 0x1800, 0x1A00)


_COPIED = re.compile(r"^\[(?P<index>[0-9A-F]{4})(?P<sub>\w*)\]$")


def data_sheet(eds: str, node: int, axes: int = 1) -> canopen.ObjectDictionary:
    """Read the object dictionary of a drive.

    Args:
        eds: path of the drive's data sheet. The simulated drive's sheet describes one axis; further axes are copies.
        node: number of the drive.
        axes: number of axes.

    Raises:
        InputError: the sheet cannot be read.
    """
    try:
        text = Path(eds).read_text(encoding="utf-8", errors="replace")
        if Path(eds).resolve() == objects.SIMULATED_EDS.resolve():
            text += "".join(_further_axis(text, axis) for axis in range(2, axes + 1))
        return import_eds(io.StringIO(text), node)
    except Exception as error:  # configparser and canopen raise many types on damaged data sheets
        raise InputError(f"is not a readable data sheet ({error})", where=eds, remedy=EDS_REMEDY) from None


def _further_axis(text: str, axis: int) -> str:
    """Sections of another axis: objects of the device profile, and process data that are off until they are set."""
    sections = []
    for section in re.split(r"^(?=\[)", text, flags=re.MULTILINE):
        name, _, body = section.partition("\n")
        match = _COPIED.match(name.strip())
        if match is None:
            continue
        index = int(match["index"], 16)
        shifted = objects.of_axis(index, axis)
        if index & 0xFE00 in _PDO:
            shifted = index + objects.PDOS_OF_AXIS * (axis - 1)
            body = re.sub(r"=\$NODEID.*", f"={objects.PDO_INVALID:#x}", body)
            body = re.sub(r"=0x([6-9]\w{3})(\w{4})$", lambda entry: _mapped(entry, axis), body, flags=re.MULTILINE)
        if shifted != index:
            sections.append(f"\n[{shifted:04X}{match['sub']}]\n{body}")
    return "".join(sections)


def _mapped(entry: re.Match[str], axis: int) -> str:
    return f"=0x{objects.of_axis(int(entry[1], 16), axis):04X}{entry[2]}"
