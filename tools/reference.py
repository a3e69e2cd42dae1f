"""Write docs/reference from the code: every key of the files a user writes, every mechanism, method and command.

python tools/reference.py            # write the pages
python tools/reference.py --check    # say which pages are not what the code says, and end with status 1
"""

from __future__ import annotations

import ast
import collections.abc
import dataclasses
import inspect
import json
import sys
import typing
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import NoneType
from typing import Any, Literal, get_args, get_origin

import typer
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from rfdropo_bayes.bayes.priors import FAMILIES, OPTIONAL
from rfdropo_bayes.cautions import Code
from rfdropo_bayes.cli.main import app
from rfdropo_bayes.deployment.objects import SIMULATED_EDS
from rfdropo_bayes.deployment.settings import Deployment
from rfdropo_bayes.deployment.vendors import WITHOUT
from rfdropo_bayes.inference.method_options import attributes_of
from rfdropo_bayes.inference.methods import METHODS
from rfdropo_bayes.mechanisms.features import KINDS
from rfdropo_bayes.mechanisms.registry import REGISTRY
from rfdropo_bayes.model.assembly import measurement_specs
from rfdropo_bayes.model.experiment import Experiment, NoiseModel
from rfdropo_bayes.model.mechanism_listings import EXAMPLE_ROBOT, first_paragraph, mechanism_facts, prior_text
from rfdropo_bayes.model.model_spec import DataChannels
from rfdropo_bayes.model.robot_listings import format_rows, robot_rows
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.robots.sections import SHAPES, SectionedBody
from rfdropo_bayes.simulators.adapters.mujoco_elements import ATTRIBUTES, Attribute
from rfdropo_bayes.simulators.mechanisms import STAGES
from rfdropo_bayes.simulators.parameters import ParameterSpec

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "reference"
NOTE = "<!-- Written by tools/reference.py from the code: change the code, then run it. -->"
NO_HELP = "--help"
SEVERAL = 2  # an option of more commands, with the same meaning, is described once


def pages() -> dict[str, str]:
    """Every page by file name."""
    return {
        "README.md": index_page(),
        "experiment.md": experiment_page(),
        "robot.md": robot_page(),
        "deployment.md": deployment_page(),
        "mechanisms.md": mechanisms_page(),
        "methods.md": methods_page(),
        "commands.md": commands_page(),
        "cautions.md": cautions_page(),
        "mujoco.md": mujoco_page(),
    }


def index_page() -> str:
    """What each page holds."""
    rows = [
        ("[experiment.md](experiment.md)", "every key of the experiment file, priors, parameters of measurements"),
        ("[robot.md](robot.md)", "every key of a robot file, and the robots that come with the package"),
        ("[deployment.md](deployment.md)", "every key of a deployment file, for sessions on motors"),
        ("[mechanisms.md](mechanisms.md)", "every mechanism: cause, remedy, parameters, default priors, where it runs"),
        ("[methods.md](methods.md)", "every method of inference and its options"),
        ("[commands.md](commands.md)", "every command of `rfdropo` and its options"),
        ("[cautions.md](cautions.md)", "every caution of a result, by its code"),
        ("[mujoco.md](mujoco.md)", "every parameter of a MuJoCo model: address, unit, default prior"),
    ]
    return page("Reference", ["These pages are written from the code.", table(("Page", "Content"), rows)])


def experiment_page() -> str:
    """Keys of the experiment file."""
    parts = [
        "An experiment is one TOML file. Lengths are in metres and times in seconds, unless a key says otherwise.",
        *key_tables(Experiment),
        "## Priors",
        "`[model.priors]` has `parameter = { distribution = NAME, ... }`; every prior is confined to the parameter's "
        "hard bounds. `sigma` of a LogNormal is the standard deviation of the logarithm.",
        table(("Distribution", "Arguments", "Optional"), prior_rows()),
        "## Parameters of measurements",
        "They stand in `[model.priors]` or `[model.fixed]` like those of the robot and of mechanisms.",
        parameter_table([(spec, needs) for spec, needs in measured_parameters()], "With"),
        "## Formats of recordings",
        table(("`[data] format`", "Files"), [(code(row["format"]), row["description"]) for row in format_rows()]),
    ]
    return page("The experiment file", parts)


def prior_rows() -> list[tuple[str, str, str]]:
    """Distributions with their arguments."""
    return [(name, ", ".join(names), ", ".join(OPTIONAL.get(name, ()))) for name, (_, names) in FAMILIES.items()]


def robot_page() -> str:
    """Keys of a robot file."""
    shapes = [text for shape in SHAPES for text in key_table(f"[[body.section]] {_tag(shape)}", shape)]
    parts = [
        "A robot is one TOML file, in SI units, in the frame of its base: z runs along the undeformed body, away from "
        'the clamp. `base = "NAME"` makes it a variant of another robot, whose tables of the same name it replaces.',
        *key_tables(Robot),
        "## [body] from shapes",
        "In the place of a section profile, `[body]` may list shapes, from the clamp to the tip.",
        keys(SectionedBody),
        *shapes,
        "## Robots that come with the package",
        table(("Robot", "Drives", "Commands", "Markers", "What"), [tuple(row.values()) for row in robot_rows()]),
    ]
    return page("The robot file", parts)


def deployment_page() -> str:
    """Keys of a deployment file."""
    parts = [
        "A deployment is one TOML file, in SI units unless a key says otherwise. Paths are relative to it. "
        "[docs/deployment.md](../deployment.md) shows their use.",
        *key_tables(Deployment),
        "## Guards",
        "`[drives] unguarded` may list these objects, if something else does the work of the missing guard.",
        table(("Object", "Without it"), [(code(f"0x{index:04X}"), words) for index, words in sorted(WITHOUT.items())]),
    ]
    return page("The deployment file", parts)


def mechanisms_page() -> str:
    """Every mechanism, stage by stage."""
    found = [mechanism_facts(name) for name in REGISTRY]
    parts = [
        "Name them under `[model] mechanisms`. At its null value a mechanism changes nothing. "
        f"Parameters per cable are those of `{EXAMPLE_ROBOT}`; sizes in the unit of commands are in metres of cable. "
        "See [docs/mechanisms.md](../mechanisms.md) for mechanisms of your own."
    ]
    for stage in STAGES:
        chosen = [(facts, rows) for facts, rows in found if facts["stage"] == stage]
        if chosen:
            parts.append(f"## {stage.capitalize()}")
        for facts, rows in chosen:
            parts += [
                f"### {facts['mechanism']}",
                facts["what"],
                f"- Cause: {facts['cause']}.\n- Remedy: {facts['remedy']}.\n- Runs on: {facts['runs on']}.",
                table(
                    ("Parameter", "Unit", "Null", "Bounds", "Default prior", "Meaning"),
                    [(code(row["parameter"]), *list(row.values())[1:]) for row in rows],
                ),
            ]
    parts += [
        "## Features of laws",
        "A [law at a port](../mechanisms.md#laws-at-ports) is a sum of coefficients times features of "
        "commands u. The shape of a low pass and of a lag is a time constant [s], the shape of a play half its width.",
        table(("Feature", "Commands", "Formula", "Shapes that audits try"), feature_rows()),
    ]
    return page("Mechanisms", parts)


def feature_rows() -> list[tuple[str, str, str, str]]:
    """Features with the formula of two commands a and b."""
    rows = []
    for name, kind in KINDS.items():
        formula = kind.formula.replace("{shape:.2g}", "shape").format("a", "b")
        rows.append((code(name), str(kind.channels), code(formula), ", ".join(map(str, kind.shapes))))
    return rows


def methods_page() -> str:
    """Every method with its options."""
    parts = [
        "`[inference] method` names one; its options stand beside it. [docs/inference.md](../inference.md) helps to "
        "choose. `rollouts` is the budget, 20000 by default, for every method that lists it."
    ]
    for name, method in METHODS.items():
        parts += [f"## {name}", first_paragraph(method.config.__doc__), option_table(method.config)]
    return page("Methods of inference", parts)


def commands_page() -> str:
    """Every command with its options."""
    root: Any = typer.main.get_command(app)
    heads, rows = ("Argument or option", "Default", "Meaning"), {}
    for name, command in walk(root, "rfdropo"):
        shown = [p for p in command.params if NO_HELP not in p.opts]
        rows[name] = [(code(written(p)), default_of(p), p.help or "") for p in shown]
    often = Counter(row for own in rows.values() for row in own)
    shared = [row for row in often if often[row] > SEVERAL]
    parts = [
        "Bad input ends with status 2 and one line with a remedy; an interrupted run ends with status 3.",
        "## Of several commands",
        table(heads, shared),
    ]
    for name, command in walk(root, "rfdropo"):
        own = [row for row in rows[name] if row not in shared]
        also = ", ".join(row[0] for row in rows[name] if row in shared)
        parts += [f"## {name}", first_paragraph(command.help)]
        parts += ([table(heads, own)] if own else []) + ([f"Also {also}."] if also else [])
    return page("Commands", parts)


def cautions_page() -> str:
    """Every code with its meaning, which follows it in the class."""
    (codes,) = ast.parse(inspect.getsource(Code)).body
    assert isinstance(codes, ast.ClassDef)
    texts = [inspect.cleandoc(node.value.value) for node in codes.body[1:] if isinstance(node, ast.Expr)]
    rows = [(code(name), " ".join(text.split())) for name, text in zip(Code, texts, strict=True)]
    parts = [
        "A caution is a reason to doubt a result. Its sentence has the numbers and a remedy; its code is for programs. "
        "Do not use the draws of a fit with a grave caution.",
        table(("Code", "Meaning"), rows),
    ]
    return page("Cautions", parts)


def mujoco_page() -> str:
    """Every attribute of every kind of element."""
    rows = [
        (code(f"{kind}/{'' if kind == 'option' else 'NAME/'}{name}"), *unit_and_prior(attribute), attribute.words)
        for kind, attributes in ATTRIBUTES.items()
        for name, attribute in attributes.items()
    ]
    parts = [
        "`[adapter.parameters]` names [parameters](../your_simulator.md) by their address. `*` in a "
        "name makes a factor on all that match. Units and scales of joints are for linear and rotational joints. A "
        "positive quantity that is zero in the file has a half-normal prior of the scale.",
        table(("Address", "Unit", "Default prior about the value in the file", "Scale", "Meaning"), rows),
    ]
    return page("Parameters of MuJoCo models", parts)


def unit_and_prior(attribute: Attribute) -> tuple[str, str, str]:
    """Unit, default prior and scale of a MuJoCo attribute."""
    unit = attribute.unit if isinstance(attribute.unit, str) else " or ".join(attribute.unit)
    typical = attribute.typical if isinstance(attribute.typical, tuple) else (attribute.typical,)
    prior = "Normal" if attribute.signed else f"LogNormal, sigma {attribute.sigma:g}"
    return unit, prior, " or ".join(f"{scale:g}" for scale in typical)


def walk(command: Any, name: str) -> Iterator[tuple[str, Any]]:
    """Every command below a group."""
    for key, child in getattr(command, "commands", {}).items():
        if hasattr(child, "commands"):
            yield from walk(child, f"{name} {key}")
        else:
            yield f"{name} {key}", child


def written(parameter: Any) -> str:
    """An option or argument as one types it."""
    if parameter.param_type_name == "option":
        return " / ".join([*parameter.opts, *parameter.secondary_opts])
    return parameter.metavar or parameter.name.upper()


def default_of(parameter: Any) -> str:
    """Default of an option of the command line, as a page shows it."""
    if parameter.required:
        return "required"
    return "" if parameter.default in (None, False, []) else str(parameter.default)


def tables_of(schema: type[BaseModel], prefix: str) -> Iterator[tuple[str, type[BaseModel]]]:
    """The tables of a file: its top level, then those below it, each with its heading as TOML writes it."""
    yield prefix or "Top level", schema
    for name, field in schema.model_fields.items():
        for inner, written in inner_tables(field.annotation):
            below = name if not prefix else f"{prefix.strip('[]')}.{name}"
            yield from tables_of(inner, written.format(below))


def inner_tables(annotation: Any) -> list[tuple[type[BaseModel], str]]:
    """The tables that a field holds, and how their headings are written: alone, in a list, or by name."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [(annotation, "[{}]")]
    origin, arguments = get_origin(annotation), get_args(annotation)
    found = [inner for argument in arguments for inner in inner_tables(argument)]
    if origin is dict:
        return [(inner, "[{}.NAME]") for inner, _ in found]
    if origin in (list, tuple):
        return [(inner, "[[{}]]") for inner, _ in found]
    return found


def key_tables(root: type[BaseModel]) -> list[str]:
    """Headings, meanings and keys of all tables of a file; tables of one kind together."""
    titles: dict[type[BaseModel], list[str]] = {}
    for title, schema in tables_of(root, ""):
        titles.setdefault(schema, []).append(title)
    return [text for schema, own in titles.items() for text in key_table(", ".join(own), schema)]


def key_table(title: str, schema: type[BaseModel]) -> list[str]:
    """Heading, meaning and keys of one table of a file."""
    meaning = first_paragraph(schema.__doc__).partition("]: ")
    text = meaning[2] or meaning[0]
    return [f"## {title}", text[:1].upper() + text[1:], keys(schema)]


def keys(schema: type[BaseModel]) -> str:
    """The keys of one table with type, default and meaning."""
    rows = [
        (code(name), type_text(field.annotation), default_text(field), limits(field) + meaning_of(schema, name))
        for name, field in schema.model_fields.items()
    ]
    return table(("Key", "Type", "Default", "Meaning"), rows)


def meaning_of(schema: type[BaseModel], name: str) -> str:
    """What a key means: by its description, else by the docstring of its table."""
    return schema.model_fields[name].description or attributes_of(schema).get(name, "").rstrip(".")


def type_text(annotation: Any) -> str:
    """A type as a reader of TOML knows it."""
    if get_origin(annotation) is Literal:
        return " or ".join(f'"{value}"' if isinstance(value, str) else str(value) for value in get_args(annotation))
    if isinstance(annotation, type) and (issubclass(annotation, BaseModel) or dataclasses.is_dataclass(annotation)):
        return "table"
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is typing.Annotated:
        return type_text(arguments[0])
    if origin in (list, tuple) and arguments:
        inner = [argument for argument in arguments if argument is not Ellipsis]
        if origin is tuple and Ellipsis not in arguments:
            return f"[{', '.join(type_text(argument) for argument in inner)}]"
        return f"list of {type_text(inner[0])}"
    if origin in (dict, collections.abc.Mapping):
        return f"table of {type_text(arguments[1])}"
    if arguments:  # a union
        return " or ".join(dict.fromkeys(type_text(a) for a in arguments if a is not NoneType))
    names = {str: "string", float: "number", int: "integer", bool: "true or false", Any: "value"}
    return names.get(annotation, getattr(annotation, "__name__", str(annotation)))


def default_text(field: FieldInfo) -> str:
    """Default of a key; empty where it may be left out and then has none."""
    if field.is_required():
        return "required"
    if isinstance(field.default, BaseModel) or field.default == str(SIMULATED_EDS):  # what its meaning says
        return ""
    return literal(None if field.default is PydanticUndefined else field.default)


def literal(value: Any) -> str:
    """A value as TOML writes it; nothing where there is none."""
    return "" if value in (None, "", (), []) else code(json.dumps(value))


def limits(field: FieldInfo) -> str:
    """Bounds of a number, in front of its meaning."""
    signs = {"gt": ">", "ge": ">=", "lt": "<", "le": "<="}
    bounds = [
        f"{sign} {getattr(entry, key):g}"
        for entry in field.metadata
        for key, sign in signs.items()
        if getattr(entry, key, None) is not None
    ]
    return f"({', '.join(bounds)}) " if bounds else ""


def measured_parameters() -> Iterator[tuple[ParameterSpec, str]]:
    """Parameters of noise and of further channels, with the setting that brings them in."""
    seen: set[str] = set()
    settings: list[dict[str, Any]] = [
        *({"noise": name} for name in get_args(NoiseModel)),
        {"tension": True},
        {"motor_angle": True},
        {"object_pose": True},
    ]
    for setting in settings:
        ((key, value),) = setting.items()
        noise, chosen = str(setting.get("noise", "auto")), {k: v for k, v in setting.items() if k != "noise"}
        for spec in measurement_specs(noise, DataChannels(**chosen)):
            if spec.name not in seen:
                seen.add(spec.name)
                yield spec, code(f'{key} = "{value}"' if isinstance(value, str) else f"{key} = true")


def parameter_table(specs: Sequence[tuple[ParameterSpec, str]], last: str) -> str:
    """Parameters with their bounds and default priors."""
    rows = [
        (code(s.name), s.unit, f"{s.nominal:g}", f"{s.low:g} to {s.high:g}", prior_text(s.prior), s.description, more)
        for s, more in specs
    ]
    return table(("Parameter", "Unit", "Nominal", "Bounds", "Default prior", "Meaning", last), rows)


def option_table(config: type) -> str:
    """The options of a method: fields of its configuration, with what its docstring says of each."""
    told, hints = attributes_of(config), typing.get_type_hints(config)
    rows = []
    for field in dataclasses.fields(config):
        default = "" if field.default is dataclasses.MISSING else literal(field.default)
        rows.append((code(field.name), type_text(hints[field.name]), default, told[field.name].rstrip(".")))
    return table(("Option", "Type", "Default", "Meaning"), rows)


def table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def code(text: str) -> str:
    """Text set as code."""
    return f"`{text}`"


def page(title: str, parts: Sequence[str]) -> str:
    """A Markdown page."""
    return "\n\n".join([f"# {title}", NOTE, *parts]) + "\n"


def _tag(shape: type[BaseModel]) -> str:
    return str(shape.model_fields["shape"].default)


def main() -> int:
    """Write the pages, or compare them."""
    stale = [name for name, text in pages().items() if not (path := FOLDER / name).exists() or path.read_text() != text]
    if "--check" in sys.argv[1:]:
        print("\n".join(f"{name} is not what the code says" for name in stale) or "the reference is what the code says")
        return 1 if stale else 0
    FOLDER.mkdir(parents=True, exist_ok=True)
    for name, text in pages().items():
        (FOLDER / name).write_text(text, encoding="utf-8")
    print("\n".join(f"wrote {FOLDER / name}" for name in stale) or "the reference was up to date")
    return 0


if __name__ == "__main__":
    sys.exit(main())
