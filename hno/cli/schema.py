"""What configurations may hold: one schema for every command."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Collection, Mapping
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, PlainValidator, ValidationError, ValidationInfo

from hno.cli.kinds import GIVEN, REGISTRIES
from hno.registry import check_options, options_of, unknown_name

LARGEST_SEED = 2**32 - 1
LOGGERS = ("csv", "tensorboard", "wandb")


class SettingsError(ValueError):
    """A configuration that makes no run; one line for every mistake."""


def _must(expected: str, met: Callable[[Any], bool]) -> PlainValidator:
    """A validator that says what it expected."""

    def check(value: Any) -> Any:
        if not met(value):
            raise ValueError(f" must be {expected}; got {value!r}.")
        return value

    return PlainValidator(check)


def _number(value: object) -> bool:
    """Whether an entry is a finite number; true and false are none."""
    return type(value) in (int, float) and math.isfinite(value)  # type: ignore[arg-type]  # a number


def _whole(least: int, most: float = math.inf, expected: str = "") -> PlainValidator:
    expected = expected or f"a whole number of at least {least}"
    return _must(expected, lambda value: type(value) is int and least <= value <= most)


def _one_of(*known: str) -> PlainValidator:
    return _must(f"one of {', '.join(known)}", lambda value: value in known)


def _types(value: Any) -> Any:
    """Player types as `hno.games.grid.parse_types` takes them."""
    if type(value) in (int, float):
        return str(value)
    if not (value is None or (isinstance(value, (str, list)) and value != "")):
        raise ValueError(f" must name player types, or list them as 1,1;2.5,4 or [[1, 1], [2.5, 4]]; got {value!r}.")
    return value


Flag = Annotated[bool, _must("true or false", lambda value: isinstance(value, bool))]
Text = Annotated[str, _must("text", lambda value: isinstance(value, str) and value != "")]
Texts = Annotated[list[str], _must("a list", lambda v: isinstance(v, list) and all(isinstance(e, str) for e in v))]
Size = Annotated[int, _whole(1)]
Count = Annotated[int, _whole(0)]
Seed = Annotated[int, _whole(0, LARGEST_SEED, f"a whole number from 0 to {LARGEST_SEED}")]
Positive = Annotated[float, _must("a positive number", lambda value: _number(value) and value > 0)]
Amount = Annotated[float, _must("a finite number of at least 0", lambda value: _number(value) and value >= 0)]
Share = Annotated[float, _must("a share of the run, from 0 to 1", lambda value: _number(value) and 0 <= value <= 1)]
Types = Annotated[Any, PlainValidator(_types)]
Paths = Annotated[
    Any, _must("a checkpoint, the folder of a run, or a list of them", lambda v: bool(v) and isinstance(v, (str, list)))
]
Device = Annotated[Any, _must("one of Lightning's", lambda v: v is not None and not isinstance(v, bool))]


def _checked(kind: str, name: object, given: object) -> dict[str, Any]:
    """Options of a registered name, with its defaults for those that are not given.

    Raises:
        ValueError: it or an option is unknown, or an option is of another type than its default.
    """
    given = given if isinstance(given, Mapping) else {}
    try:
        factory, skip = REGISTRIES[kind]().get(str(name)), GIVEN.get(kind, ())
        check_options(f"{kind} {name}", factory, given, skip=skip)
    except LookupError as error:
        raise ValueError(f": {error}") from error
    options = options_of(factory, skip=skip) | {str(key): value for key, value in given.items()}
    for key, default in options_of(factory, skip=skip).items():
        if options[key] is inspect.Parameter.empty:
            raise ValueError(f".{key} is missing: {kind} {name} has no default for it.")
        expected, met = _LIKE.get(type(default), ("", lambda value: True))
        if not met(options[key]):
            raise ValueError(f".{key} must be {expected}; got {options[key]!r}.")
    return options


_LIKE: Mapping[type, tuple[str, Callable[[Any], bool]]] = {
    bool: ("true or false", lambda value: isinstance(value, bool)),
    int: ("a whole number", lambda value: type(value) is int),
    float: ("a finite number", _number),
    str: ("text", lambda value: isinstance(value, str)),
}
"""What an option must be, by the type of its default."""


def _part(kind: str) -> PlainValidator:
    """A registered name with its options."""

    def check(content: Any) -> dict[str, Any]:
        found = _mapping(content, ("name",))
        _checked(kind, found["name"], {key: value for key, value in found.items() if key != "name"})
        return found

    return PlainValidator(check)


def _optimizer(content: Any) -> dict[str, Any]:
    """A registered optimiser with its options, and the schedule of its learning rate."""
    found = _mapping(content, ("name", *SCHEDULE))
    for key in ("lr", "final_lr"):
        if not (type(found[key]) in (int, float) and found[key] > 0):
            raise ValueError(f".{key} must be a positive number; got {found[key]!r}.")
    _checked("optimizer", found["name"], {key: value for key, value in found.items() if key not in ("name", *SCHEDULE)})
    return found


def _mapping(content: Any, needed: Collection[str] = ()) -> dict[str, Any]:
    if not isinstance(content, Mapping) or not set(needed) <= content.keys():
        entries = f" with {' and '.join(needed)}" if needed else ""
        raise ValueError(f" must be a mapping{entries}; got {content!r}.")
    return {str(key): value for key, value in content.items()}


def _operator(content: Any, info: ValidationInfo) -> dict[str, Any]:
    """A method's name, its registered function and that function's options.

    Files of games and methods set `SHARED` options; a function that does not know them is not given them.
    """
    options = _mapping(content, ("name", "function"))
    name, function = options.pop("name"), options.pop("function")
    given = (info.context or {}).get("given", ())
    registry = REGISTRIES["operator"]()
    if function in registry.names():
        known = options_of(registry.get(function), skip=GIVEN["operator"])
        options = {k: v for k, v in options.items() if k in known or k not in SHARED or f"operator.{k}" in given}
    return {"name": name, "function": function, **_checked("operator", function, options)}


SHARED = ("exact_terminal", "members")
SCHEDULE = ("lr", "schedule", "final_lr")


def _terms(content: Any) -> dict[str, dict[str, Any]]:
    """Loss terms and all their options; null removes one."""
    return {
        name: _checked("loss", name, _mapping(given)) for name, given in _mapping(content).items() if given is not None
    }


def _weights(content: Any) -> dict[str, float]:
    """Weights; null removes one."""
    found = {name: weight for name, weight in _mapping(content).items() if weight is not None}
    for name, weight in found.items():
        if not (_number(weight) and weight >= 0):
            raise ValueError(f".{name} must be a finite number of at least 0; got {weight!r}.")
    return found


def _sampler(content: Any) -> dict[str, dict[str, Any]]:
    """Shares of sources, and all their options; null removes one."""
    found = {}
    for name, entry in _mapping(content).items():
        options = _mapping({"share": entry} if not isinstance(entry, Mapping) else entry)
        share = options.pop("share", None)
        if not (_number(share) and share >= 0) and entry is not None:
            raise ValueError(f".{name} must have a share, a finite number of at least 0; got {entry!r}.")
        if entry is not None:
            found[name] = {"share": share, **_checked("source", name, options)}
    return found


class Settings(BaseModel):
    """Entries of a configuration; others are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class GameSettings(Settings):
    """Which game, and constants that differ from its defaults."""

    name: Text
    constants: Annotated[dict[str, Any], PlainValidator(_mapping)]


class BatchSizes(Settings):
    """Rows per step of each stream; null for every labelled row."""

    bvp: Size | None
    interior: Size | None
    terminal: Size | None


class DataSettings(Settings):
    """Labels and the curriculum."""

    types: Types
    trajectories: Size
    validation: Size
    batch_sizes: BatchSizes
    pretrain: Share
    widening: Share
    finish: Share
    interior_types: Annotated[str, _one_of("labelled", "box")]
    cache: Text | None
    files: Texts
    workers: Size | None


class LossSettings(Settings):
    """A method: its terms and weights."""

    terms: Annotated[dict[str, dict[str, Any]], PlainValidator(_terms)]
    weights: Annotated[dict[str, float], PlainValidator(_weights)]
    norm: Annotated[str, _one_of("huber", "l1", "l2")]
    scaled: Flag
    balance: Flag
    hardest: Annotated[float, _must("a share in (0, 1]", lambda value: _number(value) and 0 < value <= 1)]


class TrainerSettings(Settings):
    """How long and on what."""

    max_steps: Size
    accelerator: Text
    devices: Device
    precision: Device
    compile: Flag
    gradient_clip_val: Positive | None
    polish: Count
    validate_every: Size
    print_every: Size
    threads: Size | None


class LoggerSettings(Settings):
    """Where metrics go."""

    names: Annotated[
        list[str],
        _must(
            f"a list of {', '.join(LOGGERS)}",
            lambda value: isinstance(value, list) and set(map(str, value)) <= set(LOGGERS),
        ),
    ]
    project: Text
    mode: Annotated[str, _one_of("auto", "disabled", "offline", "online")]


class Episodes(Settings):
    """Under which conditions a policy is played."""

    starts: Size
    seed: Seed
    clearance: Amount
    dt: Positive
    safe: Flag
    widen: Positive
    noise: Amount
    delay: Count
    ntk: Flag
    ntk_rows: Size


class EvaluationSettings(Episodes):
    """The evaluation at the end of a training."""

    types: Types


class ValidationSettings(Settings):
    """Closed-loop validation while an operator trains."""

    types: Types
    starts: Size
    stop_when_safe: Flag
    seed: Seed


class TrainSettings(Settings):
    """`hno train`."""

    game: GameSettings
    operator: Annotated[dict[str, Any], PlainValidator(_operator)]
    network: Annotated[dict[str, Any], _part("network")]
    activation: Annotated[dict[str, Any], _part("activation")]
    data: DataSettings
    sampler: Annotated[dict[str, dict[str, Any]], PlainValidator(_sampler)]
    loss: LossSettings
    optimizer: Annotated[dict[str, Any], PlainValidator(_optimizer)]
    trainer: TrainerSettings
    logger: LoggerSettings
    evaluation: EvaluationSettings
    validation: ValidationSettings
    seed: Seed
    resume: Text | None


class EvaluateSettings(Episodes):
    """`hno evaluate`."""

    checkpoint: Paths
    expected_game: Text | None
    theta: Types
    unseen: Types
    residuals: Flag
    robustness: Flag
    conditions: Annotated[dict[str, Any], PlainValidator(_mapping)]
    online: Count
    online_interval: Size
    cache: Text | None
    workers: Size | None
    threads: Size | None


class LabelSettings(Settings):
    """`hno labels`."""

    game: GameSettings
    theta: Types
    n: Size
    seed: Seed
    split: Annotated[str, _one_of("train", "test")]
    widen: Positive
    workers: Size | None
    cache: Text | None


class ReportSettings(Settings):
    """`hno report`."""

    folder: Text
    to: Text | None
    figures: Flag
    watch: Annotated[float, _must("a number of seconds of at least 1", lambda v: _number(v) and v >= 1)] | None


S = TypeVar("S", bound=Settings)


def validated(model: type[S], content: Mapping[str, Any], given: Collection[str] = ()) -> S:
    """A configuration whose entries are all known and make sense.

    Args:
        model: the schema of the command.
        content: plain containers.
        given: keys that the command line names.

    Raises:
        SettingsError: with every mistake, what was expected and what came.
    """
    try:
        return model.model_validate(dict(content), context={"given": given})
    except ValidationError as error:
        raise SettingsError("\n".join(_sentence(model, found) for found in error.errors())) from error


def _sentence(model: type[Settings], found: Any) -> str:
    names = [str(part) for part in found["loc"]]
    key = ".".join(names)
    if found["type"] == "extra_forbidden":
        return f"{key} does not exist. {unknown_name('configuration key', names[-1], _known(model, names[:-1]))}"
    if found["type"] == "missing":
        return f"{key} is missing: give it as {key}=<value>; --help says more."
    if "error" in found.get("ctx", {}):
        return key + str(found["ctx"]["error"])
    return f"{key}: {found['msg']}; got {found['input']!r}."


def _known(model: type[Settings], above: list[str]) -> list[str]:
    """The keys of a nested model."""
    for name in above:
        model = model.model_fields[name].annotation  # type: ignore[assignment]  # of nested settings
    return sorted(model.model_fields)
