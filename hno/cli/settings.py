"""The settings of every command."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, ConfigDict, Field, model_validator

from hno.cli import schema
from hno.cli.schema import Amount, Count, Loose, Place, Positive, Probability, Seed, Settings, Share, Size, Text

Objective = Text | Annotated[list[Text], Field(min_length=1)]
"""Names of numbers that a job returns to its sweeper."""


class GameSettings(Settings):
    """Which game, and constants that differ from its defaults."""

    name: Text
    constants: dict[str, Any]

    @property
    def potential(self) -> bool:
        """Whether it is a potential game; not where it cannot be made, which its first use says."""
        from hno.games import make  # not at the top: help and completion do without torch

        try:
            return make(self.name, **self.constants).potential
        except (LookupError, TypeError, ValueError):
            return False


class Method(Settings):
    """The name of a method; its loss terms are under `loss`."""

    name: Text


class BatchSizes(Settings):
    """Rows per step of each stream; null for every labelled row."""

    bvp: Size | None
    interior: Size | None
    terminal: Size | None


class AdaptiveSettings(Settings):
    """Labels that are added while training."""

    rounds: Count
    labels: Size
    candidates: Size


class DataSettings(Settings):
    """Labels and the curriculum."""

    types: Loose | None
    widen: Annotated[list[Positive], Field(min_length=1)]
    adaptive: AdaptiveSettings
    trajectories: Size
    validation: Size
    batch_sizes: BatchSizes
    pretrain: Share
    widening: Share
    finish: Share
    interior_types: Literal["labelled", "box"]
    cache: Place | None
    files: list[Place]
    workers: Size | None


class LossSettings(Settings):
    """A method: its terms and weights; null removes one."""

    terms: schema.Terms
    weights: schema.Weights
    norm: Literal["huber", "l1", "l2"]
    scaled: bool
    balance: bool
    hardest: Annotated[float, Field(gt=0, le=1)]


class TrainerSettings(Settings):
    """How long and on what; besides these, every argument of Lightning's trainer that a training does not decide."""

    model_config = ConfigDict(extra="allow")

    max_steps: Size
    schedule_steps: Size | None
    accelerator: Text
    devices: Loose
    precision: Loose
    compile: bool
    gradient_clip_val: Positive | None
    polish: Count
    validate_every: Size
    print_every: Size
    threads: Size | None
    strategy: Text = "auto"
    profiler: Literal["simple", "advanced", "pytorch"] | None = None

    @model_validator(mode="after")
    def _arguments(self) -> Self:
        from hno.training.trainer import check_arguments  # not at the top: help and completion do without torch

        try:
            check_arguments(self.lightning, list(type(self).model_fields))
        except (LookupError, ValueError) as error:
            raise schema.SettingsError(str(error)) from error
        return self

    @property
    def lightning(self) -> dict[str, Any]:
        """Further arguments of Lightning's trainer."""
        return self.model_extra or {}


class LoggerSettings(Settings):
    """Where metrics go."""

    names: list[Literal["csv", "tensorboard", "wandb"]]
    project: Text
    mode: Literal["auto", "disabled", "offline", "online"]


class Episodes(Settings):
    """Under which conditions a policy is played."""

    starts: Size
    seed: Seed
    clearance: Amount
    dt: Positive
    safe: bool
    widen: Positive
    noise: Amount
    delay: Count
    ntk: bool
    ntk_rows: Size
    landscape: bool
    landscape_truth: Count
    off_labels: Count


class EvaluationSettings(Episodes):
    """The evaluation at the end of a training."""

    types: Loose | None


class ValidationSettings(Settings):
    """Closed-loop validation while an operator trains."""

    types: Loose | None
    starts: Size
    stop_when_safe: bool
    seed: Seed
    clearance: Amount
    dt: Positive


class TrainSettings(Settings):
    """`hno train`."""

    game: GameSettings
    operator: Method
    function: schema.Function
    network: schema.Network
    activation: schema.Activation
    data: DataSettings
    sampler: schema.Sampler
    loss: LossSettings
    optimizer: schema.Optimizer
    trainer: TrainerSettings
    logger: LoggerSettings
    evaluation: EvaluationSettings
    validation: ValidationSettings
    callbacks: schema.Callbacks = Field(default_factory=dict)
    seed: Seed
    resume: Place | None
    objective: Objective = "best/collision_rate"
    tags: list[Text] = Field(default_factory=list)
    notes: str | None = None


class EvaluateSettings(Episodes):
    """`hno evaluate`."""

    checkpoint: Annotated[
        list[Place], Field(min_length=1), BeforeValidator(lambda given: [given] if isinstance(given, str) else given)
    ]
    expected_game: Text | None
    theta: Loose | None
    unseen: Loose | None
    learns: Literal["mean", "mode", "expectation"] | None
    residuals: bool
    robustness: bool
    conditions: dict[str, Any]
    online: Count
    online_interval: Size
    cache: Place | None
    workers: Size | None
    threads: Size | None
    logger: LoggerSettings | None = None
    objective: Objective = "test/collision_rate"
    tags: list[Text] = Field(default_factory=list)
    notes: str | None = None


class LabelSettings(Settings):
    """`hno labels`."""

    game: GameSettings
    theta: Loose | None
    n: Size
    seed: Seed
    split: Literal["train", "test"]
    all_equilibria: bool | None
    widen: Positive
    workers: Size | None
    cache: Place | None


class ReportSettings(Settings):
    """`hno report`."""

    folder: Place
    to: Place | None
    figures: bool
    watch: Annotated[float, Field(ge=1)] | None


class CertifySettings(Settings):
    """`hno certify`."""

    checkpoint: Place
    expected_game: Text | None
    tests: Size
    beta: Probability
    seed: Seed
    theta: Loose
    clearance: Amount
    dt: Positive
    equilibria: Count | None
    target: Probability
    noise: Amount
    delay: Count
    workers: Size | None
    threads: Size | None


COMMANDS: dict[str, type[Settings]] = {
    "train": TrainSettings,
    "evaluate": EvaluateSettings,
    "labels": LabelSettings,
    "report": ReportSettings,
    "certify": CertifySettings,
}
"""By the name of the root configuration."""
