"""What the documentation says is so: its files work, its commands are accepted, its tutorial and its notebook run."""

from __future__ import annotations

import ast
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import NamedTuple

import pytest

from hno.cli.main import main
from hno.games import make
from hno.operators import Architecture, make_operator
from hno.training.checkpoint import Provenance, record
from hno.training.saving import seal

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
FENCE = re.compile(
    r"^```(?P<language>\w*)(?: title=\"(?P<title>[^\"]+)\")?\n(?P<text>.*?)^```$", re.MULTILINE | re.DOTALL
)
TUTORIAL = ROOT / "docs/tutorial/your-first-game.md"
NOTEBOOK = ROOT / "docs/howto/python-api.ipynb"
SLOW = "takes minutes"


class Block(NamedTuple):
    """A fenced block of a page."""

    language: str
    title: str | None
    text: str


def blocks(page: Path) -> list[Block]:
    return [Block(*found.groups()) for found in FENCE.finditer(page.read_text(encoding="utf-8"))]


def name(page: Path) -> str:
    return str(page.relative_to(ROOT))


class Shell:
    """A folder in which a reader works, with `hno` on the path.

    Args:
        folder: empty.
    """

    def __init__(self, folder: Path) -> None:
        self.at = self.folder = folder
        self.site, bin_folder = folder / "site", folder / "bin"
        self.site.mkdir(), bin_folder.mkdir()
        command = bin_folder / "hno"
        command.write_text(f"#!{sys.executable}\nfrom hno.cli.main import main\nraise SystemExit(main())\n")
        command.chmod(0o755)
        self.environment = os.environ | {
            "PATH": f"{bin_folder}:{Path(sys.executable).parent}:{os.environ['PATH']}",
            "PYTHONPATH": f"{self.site}:{ROOT}",
            "OMP_NUM_THREADS": "1",
            "WANDB_MODE": "offline",
        }

    def run(self, text: str) -> str:
        """Run lines of a shell; all must succeed. `pip install` registers a package without installing it."""
        for line in text.splitlines():
            words = shlex.split(line, comments=True)
            if words[:2] == ["pip", "install"]:
                self.install(self.at)
                continue
            if words[:1] == ["cd"]:
                self.at /= words[1]
                continue
            ended = subprocess.run(
                ["bash", "-c", line], cwd=self.at, env=self.environment, capture_output=True, text=True, check=False
            )
            assert ended.returncode == 0, f"{line}\n{ended.stdout}\n{ended.stderr}"
        return text

    def install(self, folder: Path) -> None:
        """What `pip install -e` leaves: the modules on the path, and the entry points."""
        project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
        record = self.site / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
        record.mkdir()
        (record / "METADATA").write_text(f"Name: {project['name']}\nVersion: {project['version']}\n")
        groups = project["entry-points"].items()
        text = [f"[{group}]\n" + "".join(f"{n} = {at}\n" for n, at in points.items()) for group, points in groups]
        (record / "entry_points.txt").write_text("\n".join(text))
        for package in folder.glob("*/__init__.py"):
            (self.site / package.parent.name).symlink_to(package.parent)


@pytest.fixture
def shell(tmp_path: Path) -> Shell:
    return Shell(tmp_path)


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_python_on_a_page_is_python(page: Path) -> None:
    for block in blocks(page):
        if block.language == "python":
            ast.parse(block.text, filename=name(page))


@pytest.mark.parametrize("page", [page for page in PAGES if page.parent == ROOT], ids=name)
def test_links_of_pages_outside_the_site_exist(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
        assert (ROOT / target).exists(), target


def test_pages_that_the_sources_name_exist() -> None:
    sources = [path for folder in ("hno", "conf", "benchmarks", "examples") for path in (ROOT / folder).rglob("*")]
    for path in sources:
        if path.suffix in (".py", ".yaml", ".toml"):
            for page in re.findall(r"docs/[\w/-]+\.\w+", path.read_text(encoding="utf-8")):
                assert (ROOT / page).exists(), f"{path} names {page}"


OWN = re.compile(
    r"(resume|sweep)=|=(crossing|crossroads|values|growing|parametric|lion)\b|\.(growing_residual|coasting)\b|mine\.safetensors"
)
"""What exists only after a reader has made it; other tests make it."""


def commands() -> list[str]:
    """Every command line on the pages that has a dry run."""
    found = dict.fromkeys(
        re.sub(r"^python (train|evaluate)\.py", r"hno \1", line)
        for page in PAGES
        for block in blocks(page)
        if block.language in ("", "sh")
        for line in block.text.splitlines()
    )
    known = [line for line in found if re.match(r"hno (train|evaluate|labels|report|certify)\b", line)]
    return [" ".join(map(shlex.quote, shlex.split(line, comments=True))) for line in known if not OWN.search(line)]


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A narrow-road operator with random weights, as training would have saved it."""
    game, path = make("narrow_road"), tmp_path_factory.mktemp("run") / "best.ckpt"
    kept = record(game, Architecture(), Provenance(types=[(1.0, 1.0)], draws=[]))
    weights = {f"operator.{name}": weight for name, weight in make_operator(game).state_dict().items()}
    path.write_bytes(seal({"state_dict": weights, **kept}))
    return path


@pytest.mark.parametrize("line", sorted(set(commands())))
def test_commands_on_the_pages_are_accepted(line: str, checkpoint: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of a sweep, its first job."""
    words = [word for word in shlex.split(line)[1:] if word != "-m"]
    words = [re.sub(r"^checkpoint=.*", f"checkpoint={checkpoint}", word) for word in words]
    words = [word if re.search(r"[\[;{]|^theta=", word) else re.sub(r"(?<==)([^,]+),.*", r"\1", word) for word in words]
    code = main([*words, "--dry-run"])
    assert code == 0, capsys.readouterr().err


def follow(shell: Shell, *, everything: bool) -> None:
    """Do what the tutorial says; without what takes minutes, go on with the controller that was trained in seconds."""
    for block in blocks(TUTORIAL):
        if block.language == "python":
            (shell.at / str(block.title)).write_text(block.text)
        elif block.language == "sh" and (everything or block.title != SLOW):
            shell.run(block.text)
        elif block.language == "sh":
            shutil.copytree(shell.at / "outputs/smoke", shell.at / "outputs/crossing")


@pytest.mark.slow
def test_the_tutorial_can_be_followed(shell: Shell) -> None:
    follow(shell, everything=False)
    assert (shell.at / "outputs/smoke/report.html").exists()


@pytest.mark.slow
def test_the_tutorial_ends_with_a_safe_controller(shell: Shell) -> None:
    follow(shell, everything=True)
    results = json.loads((shell.at / "outputs/crossing/results.json").read_text())
    collisions, starts = (sum(row[entry] for row in results["table"]) for entry in ("collisions", "safe_starts"))
    assert starts > 1000
    assert collisions < 0.01 * starts


@pytest.mark.slow
def test_the_notebook_prints_what_it_shows(shell: Shell) -> None:
    """Cells run one after the other, without Jupyter."""
    cells = [cell for cell in json.loads(NOTEBOOK.read_text())["cells"] if cell["cell_type"] == "code"]
    program = "".join("".join(cell["source"]) + "\nprint('\\0')\n" for cell in cells)
    (shell.folder / "notebook.py").write_text(program)
    ended = subprocess.run(
        [sys.executable, "notebook.py"],
        cwd=shell.folder,
        env=shell.environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    printed = [text.strip() for text in ended.stdout.split("\0")[:-1]]
    assert printed == ["".join("".join(o["text"]) for o in cell["outputs"]).strip() for cell in cells]


def test_the_game_with_a_clock_keeps_the_contract(shell: Shell) -> None:
    (block,) = [block for block in blocks(ROOT / "docs/guide/games.md") if block.title == "gate.py"]
    (shell.folder / "gate.py").write_text(block.text)
    shell.run("hno check-game gate:Gate")
