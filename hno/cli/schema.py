"""What configurations may hold: one schema for every command."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, PlainValidator, ValidationError

from hno.cli import parts
from hno.cli.entries import (
    Amount,
    Count,
    Device,
    Flag,
    Paths,
    Positive,
    Seed,
    Share,
    Size,
    Text,
    Texts,
    Types,
    must,
    number,
    one_of,
)  # fmt: skip
from hno.registry import unknown_name

LOGGERS = ("csv", "tensorboard", "wandb")


class SettingsError(ValueError):
    """A configuration that makes no run; one line for every mistake."""


class Settings(BaseModel):
    """Entries of a configuration; others are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class GameSettings(Settings):
    """Which game, and constants that differ from its defaults."""

    name: Text
    constants: Annotated[dict[str, Any], PlainValidator(parts.mapping)]


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
    interior_types: Annotated[str, one_of("labelled", "box")]
    cache: Text | None
    files: Texts
    workers: Size | None


class LossSettings(Settings):
    """A method: its terms and weights."""

    terms: Annotated[dict[str, dict[str, Any]], PlainValidator(parts.terms)]
    weights: Annotated[dict[str, float], PlainValidator(parts.weights)]
    norm: Annotated[str, one_of("huber", "l1", "l2")]
    scaled: Flag
    balance: Flag
    hardest: Annotated[float, must("a share in (0, 1]", lambda value: number(value) and 0 < value <= 1)]


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
        must(
            f"a list of {', '.join(LOGGERS)}",
            lambda value: isinstance(value, list) and set(map(str, value)) <= set(LOGGERS),
        ),
    ]
    project: Text
    mode: Annotated[str, one_of("auto", "disabled", "offline", "online")]


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
    operator: Annotated[dict[str, Any], PlainValidator(parts.operator)]
    network: Annotated[dict[str, Any], parts.part("network")]
    activation: Annotated[dict[str, Any], parts.part("activation")]
    data: DataSettings
    sampler: Annotated[dict[str, dict[str, Any]], PlainValidator(parts.sampler)]
    loss: LossSettings
    optimizer: Annotated[dict[str, Any], PlainValidator(parts.optimizer)]
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
    conditions: Annotated[dict[str, Any], PlainValidator(parts.mapping)]
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
    split: Annotated[str, one_of("train", "test")]
    widen: Positive
    workers: Size | None
    cache: Text | None


class ReportSettings(Settings):
    """`hno report`."""

    folder: Text
    to: Text | None
    figures: Flag
    watch: Annotated[float, must("a number of seconds of at least 1", lambda v: number(v) and v >= 1)] | None


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
