"""A MuJoCo model with other values, as the text of its file: the user's own, with calibrated values.

Numbers are written in full. If elements of the text and of the model do not correspond (replicas, composites, URDF),
MuJoCo's own text of the model is used, whose other numbers have six digits.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rfdropo_bayes.errors import InputError

ALIKE = 1e-5  # [m]: most by which markers of a file that is read back may be elsewhere in a rollout
TRIED = 50  # steps of that rollout
SECTIONS = {"tendon": "tendon", "actuator": "actuator"}
IN_BODIES = {"joint": ("joint", "freejoint"), "geom": ("geom",), "site": ("site",)}
TRANSPARENT = ("frame",)


def model_text(rollouts: Any, model: Any, path: Path, names: Iterable[str], remarks: Sequence[str]) -> str:
    """Text of an MJCF file of ``model``, which differs from the model of ``rollouts`` by the parameters of these names.

    Raises:
        InputError: the file cannot describe the model.
    """
    elements = sorted({element for name in names for element in rollouts.edits[name].elements})
    for text in _texts(rollouts.spec, path):
        written = _edited(text, model, elements, path.parent, remarks)
        if written is not None and _same(rollouts, model, written):
            return written
    raise InputError(
        "the file of the MuJoCo model cannot contain the calibrated values",
        where=str(path),
        remedy="export --phi, and set it there",
    )


def _texts(spec: Any, path: Path) -> Iterator[str]:
    """The file's own text with included files, then MuJoCo's text."""
    own = path.read_text(encoding="utf-8")
    if path.suffix == ".xml" and "<mujoco" in own:
        yield ET.tostring(_included(ET.fromstring(own), path.parent), encoding="unicode")
    yield spec.to_xml()


def _included(root: ET.Element, folder: Path) -> ET.Element:
    """An element with its ``include`` elements replaced by the included files."""
    for parent in list(root.iter()):
        for place, child in reversed(list(enumerate(list(parent)))):
            if child.tag == "include":
                inner = _included(ET.fromstring((folder / child.attrib["file"]).read_text(encoding="utf-8")), folder)
                parent[place : place + 1] = list(inner)
    return root


def _edited(
    text: str, model: Any, elements: Iterable[tuple[str, int, str]], folder: Path, remarks: Sequence[str]
) -> str | None:
    """The text with the values of a model; None if its elements do not correspond to the model's."""
    root = ET.fromstring(text)
    known = _elements_of(root)
    counts = {"joint": model.njnt, "geom": model.ngeom, "site": model.nsite, "body": model.nbody}
    counts |= {"tendon": model.ntendon, "actuator": model.nu}
    for kind, number, attribute in elements:
        if kind == "option":
            _write_option(root, model, attribute)
        elif kind == "flex" or len(known[kind]) != counts[kind]:
            return None
        else:
            _write(root, known[kind][number], model, kind, number, attribute)
    _find_files(root, folder)
    ET.indent(root)
    said = "\n".join(f"  {line}" for line in remarks).replace("--", "- -")
    return f"<!--\n{said}\n-->\n{ET.tostring(root, encoding='unicode')}\n"


def _elements_of(root: ET.Element) -> dict[str, list[ET.Element]]:
    """Elements of each kind in the order of the compiled model."""
    elements: dict[str, list[ET.Element]] = {"body": [], "joint": [], "geom": [], "site": []}

    def visit(body: ET.Element) -> None:
        elements["body"].append(body)
        inner: list[ET.Element] = []

        def own(element: ET.Element) -> None:
            for child in element:
                if child.tag in TRANSPARENT:
                    own(child)
                elif child.tag == "body":
                    inner.append(child)
                for kind, tags in IN_BODIES.items():
                    if child.tag in tags:
                        elements[kind].append(child)

        own(body)
        for child in inner:
            visit(child)

    worlds = root.findall("worldbody")
    whole = ET.Element("worldbody")
    for world in worlds:
        whole.extend(list(world))
    visit(whole)
    for kind, section in SECTIONS.items():
        elements[kind] = [child for part in root.findall(section) for child in part]
    return elements


def _words(values: Any) -> str:
    return " ".join(repr(float(value)) for value in np.atleast_1d(values))


def _write(root: ET.Element, element: ET.Element, model: Any, kind: str, number: int, attribute: str) -> None:
    if kind == "body" and attribute in ("mass", "inertia", "com_x", "com_y", "com_z"):
        _write_inertial(root, element, model, number)
    elif kind == "body" and attribute == "gravcomp":
        element.set("gravcomp", _words(model.body_gravcomp[number]))
    elif attribute.startswith("pos_"):
        element.set("pos", _words(model.body_pos[number] if kind == "body" else model.site_pos[number]))
    elif kind == "joint":
        _write_joint(root, element, model, number, attribute)
    elif kind == "tendon":
        name = f"tendon_{'lengthspring' if attribute == 'springlength' else attribute}"
        _first_word(element, attribute, getattr(model, name)[number])
    elif kind == "geom" and attribute.startswith("friction"):
        element.set("friction", _words(model.geom_friction[number]))
    elif kind == "geom":
        element.set("solref", _words(model.geom_solref[number]))
    else:
        _write_actuator(element, model, number)


def _first_word(element: ET.Element, name: str, values: Any) -> None:
    """Replace the first numbers of an attribute; later numbers, such as coefficients, are kept."""
    given = np.atleast_1d(values)
    rest = element.get(name, "").split()[len(given) :]
    element.set(name, " ".join([_words(given), *rest]))


def _write_joint(root: ET.Element, element: ET.Element, model: Any, number: int, attribute: str) -> None:
    dof, place = int(model.jnt_dofadr[number]), int(model.jnt_qposadr[number])
    if attribute == "springref":
        compiler = root.find("compiler")
        degrees = int(model.jnt_type[number]) == 3 and (compiler is None or compiler.get("angle", "degree") == "degree")
        value = model.qpos_spring[place]
        element.set("springref", _words(np.degrees(value) if degrees else value))
        return
    value = model.jnt_stiffness[number] if attribute == "stiffness" else getattr(model, f"dof_{attribute}")[dof]
    _first_word(element, attribute, value)


def _write_inertial(root: ET.Element, body: ET.Element, model: Any, number: int) -> None:
    """Write mass and inertia of a body, possibly derived from its geoms."""
    compiler = root.find("compiler")
    if compiler is not None and compiler.get("inertiafromgeom") == "true":
        compiler.set("inertiafromgeom", "auto")
        for parent in list(root.iter("body")):
            for stated in parent.findall("inertial"):
                parent.remove(stated)
    for stated in body.findall("inertial"):
        body.remove(stated)
    values = {
        "pos": model.body_ipos[number],
        "quat": model.body_iquat[number],
        "mass": model.body_mass[number],
        "diaginertia": model.body_inertia[number],
    }
    body.insert(0, ET.Element("inertial", {name: _words(value) for name, value in values.items()}))


def _write_actuator(element: ET.Element, model: Any, number: int) -> None:
    gain, bias = model.actuator_gainprm[number], model.actuator_biasprm[number]
    dynamics = model.actuator_dynprm[number]
    gear = np.array(model.actuator_gear[number])
    if element.tag == "position":
        element.attrib.pop("dampratio", None)
        element.set("kp", _words(gain[0]))
        if bias[2] != 0.0:
            element.set("kv", _words(-bias[2]))
        if "timeconst" in element.attrib:
            element.set("timeconst", _words(dynamics[0]))
    elif element.tag == "velocity":
        element.set("kv", _words(gain[0]))
    elif element.tag == "motor":
        gear *= gain[0]  # a motor's gain is one: its gear does the same
    elif element.tag == "general":
        for name, values in (("gainprm", gain), ("biasprm", bias), ("dynprm", dynamics)):
            last = np.flatnonzero(values)
            element.set(name, _words(values[: last[-1] + 1 if len(last) else 1]))
    element.set("gear", _words(gear))


def _write_option(root: ET.Element, model: Any, attribute: str) -> None:
    option = root.find("option")
    if option is None:
        option = ET.SubElement(root, "option")
    name = "gravity" if attribute.startswith("gravity") else attribute
    option.set(name, _words(getattr(model.opt, name)))


def _find_files(root: ET.Element, folder: Path) -> None:
    """Give meshes and textures absolute paths."""
    compiler = root.find("compiler")
    settings = {} if compiler is None else compiler.attrib
    places = [folder / settings.get(key, "") for key in ("meshdir", "texturedir", "assetdir")] + [folder]
    for element in root.iter():
        name = element.get("file")
        if name is not None and element.tag != "include":
            file = next((place / name for place in places if (place / name).is_file()), None)
            element.set("file", name if file is None else str(file.resolve()))


def _same(rollouts: Any, model: Any, text: str) -> bool:
    """Whether a text that is read back moves as the model does."""
    import mujoco

    try:
        read = mujoco.MjSpec.from_string(text).compile()
    except ValueError:
        return False
    if (read.nq, read.nv, read.nbody, read.nu) != (model.nq, model.nv, model.nbody, model.nu):
        return False
    moved = [_moved(each) for each in (model, read)]
    return bool(np.max(np.abs(moved[0] - moved[1]), initial=0.0) < ALIKE)


def _moved(model: Any) -> np.ndarray:
    """Places of all bodies in a few steps under commands that begin at once."""
    import mujoco

    data, places = mujoco.MjData(model), []
    high = np.where(np.ptp(model.actuator_ctrlrange, axis=1) > 0.0, model.actuator_ctrlrange[:, 1], 1.0)
    for step in range(TRIED):
        data.ctrl[: model.nu] = 0.1 * high * np.sin(0.1 * step + np.arange(model.nu))
        mujoco.mj_step(model, data)
        places.append(np.array(data.xpos))
    return np.stack(places)
