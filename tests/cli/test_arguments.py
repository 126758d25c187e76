"""Words of a command line, in any order."""

from __future__ import annotations

import pytest

from hno.cli.arguments import UsageError, parse, rewritten

GROUPS = ("game", "activation")


def test_flags_may_stand_anywhere() -> None:
    given = parse(["game=drone", "-m", "seed=1,2", "--to", "out put", "--config-dir=mine", "~seed", "word"])
    assert given.overrides == ["game=drone", "seed=1,2", "~seed"]
    assert given.words == ["word"]
    assert given.flags == {"--multirun": "", "--to": "out put", "--config-dir": "mine"}


@pytest.mark.parametrize(
    ("words", "message"),
    [(["--too", "x"], "Did you mean '--to'?"), (["--to"], "--to needs a value"), (["--dryrun"], "'--dry-run'")],
)
def test_unknown_flags_and_missing_values_are_refused(words: list[str], message: str) -> None:
    with pytest.raises(UsageError, match=message.replace("?", r"\?")):
        parse(words)


@pytest.mark.parametrize(
    ("given", "wanted"),
    [
        ("game=drone", "game=drone"),
        ("+game=drone", "game=drone"),
        ("trainer.max_steps=5", "++trainer.max_steps=5"),
        ("+trainer.max_steps=5", "++trainer.max_steps=5"),
        ("++trainer.max_steps=5", "++trainer.max_steps=5"),
        ("game.constants.radius=1", "++game.constants.radius=1"),
        ("~loss.weights.value", "~loss.weights.value"),
        ("hydra.run.dir=x", "hydra.run.dir=x"),
        ("hydra/launcher=joblib", "hydra/launcher=joblib"),
        ("mine=choice", "mine=choice"),
        ("theta=1,1;2.5,4", "++theta='1,1;2.5,4'"),
        ("data.types=1,1", "++data.types='1,1'"),
        ("theta='1,1;2.5,4'", "++theta='1,1;2.5,4'"),
        ("theta=grid5,grid9", "++theta=grid5,grid9"),
        ("data.types=[[1,1],[5,5]]", "++data.types=[[1,1],[5,5]]"),
        ("seed=0,1,2", "++seed=0,1,2"),
        ("sampler.band=0.2,0.5", "++sampler.band.share=0.2,0.5"),
        ("sampler.band.reach=2", "++sampler.band.reach=2"),
        ("sampler.band=null", "++sampler.band=null"),
    ],
)
def test_overrides_are_written_as_hydra_takes_them(given: str, wanted: str) -> None:
    assert rewritten(given, GROUPS, {"mine"}) == wanted
