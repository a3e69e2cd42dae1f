"""Parameters of a MuJoCo model: elements and attributes by address, with units, bounds and priors.

An address is ``kind/name/attribute``: ``joint/elbow/damping``. The number of an element, from zero, replaces its name
if it has none, and ``*`` in a name matches any text: the parameter is then a factor on all of them. Options have no
name: ``option/gravity_z``. docs/reference/mujoco.md lists `ATTRIBUTES`.
"""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Any, NamedTuple

import numpy as np

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.robots.parameter import Parameter
from rfdropo_bayes.tables import nearest

RANGE = 1e3  # hard bounds of a positive quantity are its nominal value over and times this
FACTOR_SIGMA = 0.3  # of the logarithm of factors
TURNING, SLIDING = "rotational", "linear"


class Attribute(NamedTuple):
    """An attribute of a kind of element."""

    # fields of MjModel that change by the same factor, each with a column (None for all columns) and a sign
    fields: tuple[tuple[str, int | None, float], ...]
    unit: str | tuple[str, str]  # SI unit; one for linear and one for rotational motion if these differ
    signed: bool  # whether the attribute may be negative
    sigma: float  # standard deviation of the logarithm under the default prior
    # scale of the default prior for attributes that are zero or may be negative; in ``unit``
    typical: float | tuple[float, float]
    words: str  # description


def _plain(field: str, unit: str | tuple[str, str], sigma: float, typical: Any, words: str) -> Attribute:
    return Attribute(((field, None, 1.0),), unit, False, sigma, typical, words)


def _axes(field: str, prefix: str, unit: str, typical: float, words: str) -> dict[str, Attribute]:
    return {
        f"{prefix}_{axis}": Attribute(((field, k, 1.0),), unit, True, 0.0, typical, f"{words} along {axis}")
        for k, axis in enumerate("xyz")
    }


PER = {"stiffness": ("N/m", "N m/rad"), "damping": ("N s/m", "N m s/rad"), "force": ("N", "N m")}
ATTRIBUTES: dict[str, dict[str, Attribute]] = {
    "body": {
        "mass": Attribute(
            (("body_mass", None, 1.0), ("body_inertia", None, 1.0)), "kg", False, 0.3, 0.1, "mass, and inertia with it"
        ),
        "inertia": _plain("body_inertia", "-", 0.3, 0.1, "factor on the moments of inertia"),
        **_axes("body_ipos", "com", "m", 0.01, "centre of mass in the body's frame"),
        **_axes("body_pos", "pos", "m", 0.005, "place in the parent's frame"),
        "gravcomp": Attribute((("body_gravcomp", None, 1.0),), "-", True, 0.0, 0.3, "share of gravity balanced"),
    },
    "joint": {
        "stiffness": _plain("jnt_stiffness", PER["stiffness"], 0.5, (100.0, 1.0), "stiffness"),
        "damping": _plain("dof_damping", PER["damping"], 0.7, (1.0, 0.1), "damping"),
        "armature": _plain("dof_armature", ("kg", "kg m2"), 0.5, (0.1, 0.01), "inertia of the rotor"),
        "frictionloss": _plain("dof_frictionloss", PER["force"], 0.7, (1.0, 0.1), "dry friction"),
        "springref": Attribute(
            (("qpos_spring", None, 1.0),), ("m", "rad"), True, 0.0, (0.005, 0.1), "rest of the spring"
        ),
    },
    "tendon": {
        "stiffness": _plain("tendon_stiffness", "N/m", 0.5, 100.0, "stiffness"),
        "damping": _plain("tendon_damping", "N s/m", 0.7, 1.0, "damping"),
        "armature": _plain("tendon_armature", "kg", 0.5, 0.1, "inertia of its winch"),
        "frictionloss": _plain("tendon_frictionloss", "N", 0.7, 1.0, "dry friction"),
        "springlength": _plain("tendon_lengthspring", "m", 0.05, 0.01, "rest length of the spring"),
    },
    "geom": {
        "friction": Attribute((("geom_friction", 0, 1.0),), "-", False, 0.3, 0.5, "sliding friction"),
        "friction_torsional": Attribute((("geom_friction", 1, 1.0),), "m", False, 0.5, 0.005, "torsional friction"),
        "friction_rolling": Attribute((("geom_friction", 2, 1.0),), "m", False, 0.5, 1e-4, "rolling friction"),
        "solref_time": Attribute((("geom_solref", 0, 1.0),), "s", False, 0.5, 0.02, "time constant of contacts"),
        "solref_damping": Attribute((("geom_solref", 1, 1.0),), "-", False, 0.3, 1.0, "damping ratio of contacts"),
    },
    "site": _axes("site_pos", "pos", "m", 0.005, "place on its body"),
    "actuator": {
        "gain": Attribute((("actuator_gainprm", 0, 1.0),), "-", False, 0.3, 1.0, "gain, in units of force per command"),
        "kp": Attribute(
            (("actuator_gainprm", 0, 1.0), ("actuator_biasprm", 1, -1.0)), "-", False, 0.5, 1.0, "gain of position"
        ),
        "kv": Attribute((("actuator_biasprm", 2, -1.0),), "-", False, 0.5, 1.0, "gain of velocity"),
        "gear": Attribute((("actuator_gear", 0, 1.0),), "-", True, 0.0, 0.1, "gear ratio"),
        "offset": Attribute((("actuator_biasprm", 0, 1.0),), "-", True, 0.0, 0.1, "force at no command"),
        "time_constant": Attribute(
            (("actuator_dynprm", 0, 1.0),), "s", False, 0.5, 0.05, "time constant of activation"
        ),
    },
    "flex": {
        "stiffness": Attribute(
            (("flex_stiffness", None, 1.0), ("flex_bending", None, 1.0)),
            "-",
            False,
            0.5,
            1.0,
            "factor on Young's modulus",
        ),
        "damping": _plain("flex_damping", "s", 0.7, 0.01, "damping"),
        "edgestiffness": _plain("flex_edgestiffness", "N/m", 0.5, 100.0, "stiffness of edges"),
        "edgedamping": _plain("flex_edgedamping", "N s/m", 0.7, 1.0, "damping of edges"),
    },
    "option": {
        **_axes("opt.gravity", "gravity", "m/s2", 0.5, "gravity"),
        "density": _plain("opt.density", "kg/m3", 0.1, 1.2, "density of the medium"),
        "viscosity": _plain("opt.viscosity", "Pa s", 0.5, 2e-5, "viscosity of the medium"),
    },
}
"""Possible parameters, by kind of element and attribute."""

RELATIVE = (("body", "inertia"), ("flex", "stiffness"))
"""Attributes of one element that are factors, as no single number has a meaning."""
COUNTS = {"body": "nbody", "joint": "njnt", "tendon": "ntendon", "geom": "ngeom", "site": "nsite", "actuator": "nu"}
OBJECTS = {name: f"mjOBJ_{name.upper()}" for name in ATTRIBUTES}
SEARCHED = {
    "body": ("mass",),
    "joint": ("stiffness", "damping", "armature", "frictionloss"),
    "tendon": ("stiffness", "damping", "armature", "frictionloss"),
    "actuator": ("gain", "kp", "kv", "time_constant"),
    "option": ("gravity_x", "gravity_y", "gravity_z"),
}
"""Attributes of all elements that an audit tests if they are not inferred."""


class Place(NamedTuple):
    """Entries of a field of MjModel."""

    field: str
    entries: tuple[Any, ...]
    sign: float


class Edit(NamedTuple):
    """Effect of one parameter on a model."""

    places: tuple[Place, ...]  # changed entries
    nominal: float  # value in the model
    form: str  # "value"; "factor" on the model's value; or "offset", added to it
    # (kind, number, attribute) of the changed elements, for the file of a calibrated model
    elements: tuple[tuple[str, int, str], ...]

    def apply(self, model: Any, value: float) -> None:
        """Change a model in place that other parameters may have changed before."""
        for field, entries, sign in self.places:
            array = field_of(model, field)
            if self.form == "offset":
                array[entries] += sign * value
            elif self.form == "factor":
                array[entries] *= value
            elif self.nominal != 0.0:
                array[entries] *= value / self.nominal
            else:
                array[entries] = sign * value


def field_of(model: Any, name: str) -> Any:
    """An array of an MjModel, or of its options."""
    owner, _, attribute = name.rpartition(".")
    if not owner:
        return getattr(model, name)
    field = getattr(getattr(model, owner), attribute)
    return field if isinstance(field, np.ndarray) else _Scalar(getattr(model, owner), attribute)


class _Scalar:
    """A number of an MjModel in the place of an array of one entry."""

    def __init__(self, owner: Any, name: str) -> None:
        self.owner, self.name = owner, name

    def __getitem__(self, index: Any) -> Any:
        return np.asarray(getattr(self.owner, self.name))

    def __setitem__(self, index: Any, value: Any) -> None:
        setattr(self.owner, self.name, float(np.asarray(value).reshape(())))


def element_names(model: Any, kind: str) -> list[str]:
    """Names of all elements of a kind, in their order; an element without a name has its number."""
    import mujoco

    count = model.nflex if kind == "flex" else getattr(model, COUNTS[kind])
    kind_of = getattr(mujoco.mjtObj, OBJECTS[kind])
    return [mujoco.mj_id2name(model, kind_of, k) or str(k) for k in range(count)]


def number_of(model: Any, kind: str, name: str | int, *, where: str) -> int:
    """Number of an element, by its name or number.

    Raises:
        InputError: no element has this name; the nearest names are listed.
    """
    names = element_names(model, kind)
    if str(name) in names:
        return names.index(str(name))
    if str(name).isdigit() and int(name) < len(names):
        return int(name)
    remedy = nearest(str(name), names) if names else f"the model has no {kind}"
    raise InputError(f"no {kind} {str(name)!r}", where=where, remedy=remedy)


def edit_of(model: Any, address: str, *, form: str | None = None) -> tuple[Edit, Attribute, str]:
    """The edit of an address, its attribute and its unit.

    Args:
        model: MjModel, unchanged.
        address: ``kind/name/attribute``, or ``option/attribute``.
        form: form of the edit; by default the value of one element, and a factor on several.

    Raises:
        InputError: no such kind, element or attribute, with the nearest names; or a factor on zero.
    """
    where = f"address {address!r}"
    kind, _, rest = address.partition("/")
    name, _, attribute = rest.rpartition("/")
    if kind not in ATTRIBUTES or not rest or (kind != "option" and not name):
        remedy = nearest(kind, ATTRIBUTES) if kind not in ATTRIBUTES else "write kind/name/attribute"
        raise InputError("is not an address", where=where, remedy=remedy)
    known = ATTRIBUTES[kind].get(attribute)
    if known is None:
        remedy = nearest(attribute, ATTRIBUTES[kind])
        raise InputError(f"a {kind} has no attribute {attribute!r}", where=where, remedy=remedy)
    several = "*" in name or "?" in name
    if several:
        numbers = [k for k, own in enumerate(element_names(model, kind)) if fnmatchcase(own, name)]
        numbers = [k for k in numbers if _values(model, kind, k, known).any()]
        if not numbers:
            remedy = "give one element, or another pattern"
            raise InputError(f"no {kind} matches that has a {attribute} to scale", where=where, remedy=remedy)
    else:
        numbers = [0 if kind == "option" else number_of(model, kind, name, where=where)]
    relative = several or (kind, attribute) in RELATIVE
    places = tuple(place for k in numbers for place in places_of(model, kind, k, known))
    nominal = _nominal(model, places, where)
    chosen = form or ("factor" if relative else "value")
    if chosen == "factor" and nominal == 0.0 and not several:
        raise InputError(f"its {attribute} is zero: no factor changes it", where=where, remedy="infer its value")
    edit = Edit(places, nominal, chosen, tuple((kind, k, attribute) for k in numbers))
    return edit, known, "-" if chosen == "factor" else unit_of(model, kind, numbers[0], known)


def _values(model: Any, kind: str, number: int, attribute: Attribute) -> np.ndarray:
    place = places_of(model, kind, number, attribute)[0]
    return np.asarray(field_of(model, place.field)[place.entries])


def _nominal(model: Any, places: Sequence[Place], where: str) -> float:
    """Value of the first of some places."""
    field, entries, sign = places[0]
    values = np.unique(np.asarray(field_of(model, field)[entries]))
    if len(values) == 0:
        raise InputError("the element has no such attribute", where=where, remedy="choose another attribute")
    return float(sign * values[-1])


def places_of(model: Any, kind: str, number: int, attribute: Attribute) -> tuple[Place, ...]:
    """Entries of all fields in which an attribute of an element stands."""
    places = []
    for field, column, sign in attribute.fields:
        rows: Any = number
        if kind == "joint" and field.startswith(("dof_", "qpos_")):
            rows = _joint_rows(model, number, field)
        elif kind == "flex" and field in ("flex_stiffness", "flex_bending"):
            rows = _flex_rows(model, number, field)
            if rows.start == rows.stop:
                continue
        if field.startswith("opt."):
            index: tuple[Any, ...] = () if column is None else (column,)
        else:
            index = (rows,) if column is None else (rows, column)
        places.append(Place(field, index, sign))
    return tuple(places)


def _joint_rows(model: Any, number: int, field: str) -> slice:
    starts = model.jnt_dofadr if field.startswith("dof_") else model.jnt_qposadr
    end = model.nv if field.startswith("dof_") else model.nq
    first = int(starts[number])
    return slice(first, int(starts[number + 1]) if number + 1 < model.njnt else end)


def _flex_rows(model: Any, number: int, field: str) -> slice:
    starts, whole = getattr(model, f"{field}adr"), len(getattr(model, field))
    first = int(starts[number])
    later = [int(start) for start in starts if start > first]
    return slice(first, first) if first < 0 else slice(first, min(later, default=whole))


def unit_of(model: Any, kind: str, number: int, attribute: Attribute) -> str:
    """SI unit of an attribute of an element."""
    if isinstance(attribute.unit, str):
        return attribute.unit
    return attribute.unit[1] if motion_of(model, number) == TURNING else attribute.unit[0]


def motion_of(model: Any, joint: int) -> str:
    """Whether a joint turns or slides; a free one slides."""
    return TURNING if int(model.jnt_type[joint]) in (1, 3) else SLIDING


def parameter_of(edit: Edit, attribute: Attribute, unit: str, words: str, given: Mapping[str, Any]) -> Parameter:
    """A parameter with the bounds and the default prior of its kind, unless ``given`` has others."""
    typical = attribute.typical if isinstance(attribute.typical, float) else attribute.typical[unit in _OF_TURNING]
    nominal = {"value": edit.nominal, "factor": 1.0, "offset": 0.0}[edit.form]
    prior: dict[str, Any]
    if edit.form == "offset" or attribute.signed:
        reach = 20.0 * max(typical, abs(nominal))
        low, high, prior = (
            nominal - reach,
            nominal + reach,
            {"distribution": "Normal", "loc": nominal, "scale": typical},
        )
    elif nominal == 0.0:
        low, high, prior = 0.0, RANGE * typical, {"distribution": "HalfNormal", "scale": typical}
    else:
        sigma = FACTOR_SIGMA if edit.form == "factor" and len(edit.elements) == 1 else attribute.sigma
        low, high = nominal / RANGE, nominal * RANGE
        prior = {"distribution": "LogNormal", "median": nominal, "sigma": sigma}
    fields = {"unit": unit, "low": low, "high": high, "nominal": nominal, "prior": prior, "description": words}
    return Parameter(**{**fields, **given})


_OF_TURNING = {"N m/rad", "N m s/rad", "N m", "kg m2", "rad"}


def searched(
    model: Any, taken: Sequence[tuple[str, int, str]], bodies: Sequence[int]
) -> Iterator[tuple[str, str, Edit, Parameter]]:
    """Candidates of an audit that are not inferred: name, quantity, edit and parameter of each scalar of the model.

    A nonzero quantity changes by a factor, and gravity by an offset, so that the same prior applies everywhere.

    Args:
        model: MjModel, unchanged.
        taken: (kind, number, attribute) of inferred scalars.
        bodies: measured bodies; bodies and joints of kinematic trees without any of them are left out.
    """
    trees = {int(model.body_rootid[body]) for body in bodies}
    for kind, attributes in SEARCHED.items():
        names = ["option"] if kind == "option" else element_names(model, kind)
        for attribute in attributes:
            for number, name in enumerate(names):
                if (kind, number, attribute) in taken or not _matters(model, kind, number, attribute, trees):
                    continue
                place = places_of(model, kind, number, ATTRIBUTES[kind][attribute])[0]
                form = "value" if not np.any(field_of(model, place.field)[place.entries]) else "factor"
                address = f"option/{attribute}" if kind == "option" else f"{kind}/{number}/{attribute}"
                edit, known, unit = edit_of(model, address, form="offset" if kind == "option" else form)
                words = known.words if kind == "option" else f"{kind} {name}: {known.words}"
                given: dict[str, Any] = {}
                if edit.form == "factor":
                    given = {"low": 1.0 / RANGE, "high": RANGE, "prior": dict(_FACTOR)}
                family = "gravity" if kind == "option" else f"{kind}_{attribute}" + "_scale" * (edit.form == "factor")
                if kind == "joint" and edit.form == "value" and motion_of(model, number) == SLIDING:
                    family += "_sliding"  # in another unit than for rotational joints
                own = attribute.removeprefix("gravity_") if kind == "option" else plain_name(name)
                yield f"{family}_{own}", family, edit, parameter_of(edit, known, unit, words, given)


_FACTOR = {"distribution": "Normal", "loc": 1.0, "scale": FACTOR_SIGMA}


def _matters(model: Any, kind: str, number: int, attribute: str, trees: Container[int]) -> bool:
    """Whether an attribute of an element can be wrong: masses of moving bodies, gains of actuators that have them."""
    if kind == "body":
        moves = model.body_mass[number] > 0.0 and model.body_weldid[number] != 0
        return bool(moves) and int(model.body_rootid[number]) in trees
    if kind == "joint":
        return int(model.body_rootid[model.jnt_bodyid[number]]) in trees
    if kind == "actuator":
        feedback = model.actuator_biasprm[number]
        present = {
            "gain": model.actuator_gainprm[number][0] != 0.0 and feedback[1] == 0.0,
            "kp": feedback[1] != 0.0,
            "kv": feedback[2] != 0.0,
            "time_constant": int(model.actuator_dyntype[number]) != 0 and model.actuator_dynprm[number][0] > 0.0,
        }
        return bool(present[attribute])
    return True


def plain_name(name: str) -> str:
    """A name of letters, digits and underscores."""
    return "".join(c if c.isalnum() and c.isascii() else "_" for c in name)
