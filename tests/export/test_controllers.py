"""What generated controllers do with questions, good and bad, and with types that change."""

from __future__ import annotations

import ctypes
import importlib.util
import json
import re
import shutil
import subprocess
import sys
import warnings
from pathlib import Path
from types import ModuleType

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from hno.export.onnx_model import OPSET
from hno.export.trace import answers, in_double, points
from tests.export.conftest import operator_of

CASE = "narrow_road potential sin 1"
STRICT = ["-std=c99", "-pedantic", "-O3", "-Wall", "-Wextra", "-Werror"]
COMPILERS = [name for name in ("gcc", "clang") if shutil.which(name)]


def asked(size: int = 40) -> list[np.ndarray]:
    return [np.ascontiguousarray(part.float().numpy()) for part in points(operator_of(CASE).game, size, 5).values()]


def wanted(size: int = 40) -> dict[str, np.ndarray]:
    operator = in_double(operator_of(CASE))
    return {name: part.numpy() for name, part in answers(operator)(*points(operator.game, size, 5).values()).items()}


class Controller:
    """A library in C, called as C would."""

    def __init__(self, path: Path, header: str) -> None:
        self.library = ctypes.CDLL(str(path))
        self.codes = {name: int(code) for name, code in re.findall(r"#define (HNO_\w+) \(?(-?\d+)\)?(?= )", header)}
        self.prepared = np.zeros(100_000, np.uint8)

    def call(self, name: str, *arguments: object) -> int:
        return int(getattr(self.library, name)(*map(as_c, arguments)))


def as_c(argument: object) -> object:
    """An argument for ctypes."""
    if isinstance(argument, np.ndarray):
        return argument.ctypes.data_as(ctypes.c_void_p)
    return ctypes.c_float(argument) if isinstance(argument, float) else argument


@pytest.fixture(scope="module")
def controller(exported, tmp_path_factory: pytest.TempPathFactory) -> Controller:
    folder, made = exported(CASE, "c"), tmp_path_factory.mktemp("library")
    for compiler in COMPILERS:
        library = made / f"{compiler}.so"
        command = [compiler, *STRICT, "-shared", "-fPIC", "-o", str(library), str(folder / "hno_controller.c"), "-lm"]
        ended = subprocess.run(command, capture_output=True, text=True, check=False)
        assert ended.returncode == 0, ended.stderr
    return Controller(made / f"{COMPILERS[0]}.so", (folder / "hno_controller.h").read_text())


def test_c_answers_controls_values_and_costates(controller: Controller) -> None:
    found = wanted()
    for row, (tau, x, theta) in enumerate(zip(*asked(), strict=True)):
        assert controller.call("hno_prepare", theta, controller.prepared) == 0
        for name, expected in (("control", "control"), ("value", "players"), ("costate", "costate")):
            out = np.zeros_like(found[expected][row], np.float32)
            assert controller.call(f"hno_{name}", controller.prepared, float(tau), x, out) == 0
            np.testing.assert_allclose(out, found[expected][row], atol=1e-5 * np.abs(found[expected]).max())


def test_c_many_types_share_one_state(controller: Controller, exported) -> None:
    """Each type gets what it gets alone; answers that are not wanted are left out."""
    header = (exported(CASE, "c") / "hno_controller.h").read_text()
    size = 8 + 4 * sum(map(int, re.findall(r"float p\d+\[(\d+)\]", header)))
    tau, x, theta = asked()
    prepared, u, single = np.zeros((5, size), np.uint8), np.zeros((5, 2, 2), np.float32), np.zeros((2, 2), np.float32)
    value, lone = np.zeros((5, 2), np.float32), np.zeros(2, np.float32)
    for row in range(5):
        controller.call("hno_prepare", theta[row], prepared[row])
    assert controller.call("hno_many_types", prepared, 5, float(tau[0]), x[0], value, None, u) == 0
    for row in range(5):
        controller.call("hno_control", prepared[row], float(tau[0]), x[0], single)
        controller.call("hno_value", prepared[row], float(tau[0]), x[0], lone)
        np.testing.assert_allclose(u[row], single, atol=1e-4)
        np.testing.assert_allclose(value[row], lone, rtol=1e-5)
    assert controller.call("hno_many_types", prepared, -1, float(tau[0]), x[0], None, None, u) == -5


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"tau": -0.1}, "HNO_ERROR_TAU"),
        ({"tau": 3.1}, "HNO_ERROR_TAU"),
        ({"tau": float("nan")}, "HNO_ERROR_NOT_FINITE"),
        ({"entry": float("nan")}, "HNO_ERROR_NOT_FINITE"),
        ({"entry": float("inf")}, "HNO_ERROR_NOT_FINITE"),
        ({"x": None}, "HNO_ERROR_NULL"),
        ({"u": None}, "HNO_ERROR_NULL"),
        ({"prepared": None}, "HNO_ERROR_NULL"),
        ({"prepared": np.zeros(100_000, np.uint8)}, "HNO_ERROR_PREPARED"),
    ],
)
def test_c_refuses_and_leaves_the_controls(controller: Controller, change: dict[str, object], code: str) -> None:
    _, x, theta = (part[0].copy() for part in asked())
    controller.call("hno_prepare", theta, controller.prepared)
    u = np.full((2, 2), 7, np.float32)
    x[1, 2] = change.pop("entry", x[1, 2])
    given = {"prepared": controller.prepared, "tau": 1.0, "x": x, "u": u} | change
    assert controller.call("hno_control", *given.values()) == controller.codes[code]
    assert (u == 7).all()


def test_c_warns_outside_its_boxes(controller: Controller) -> None:
    _, x, theta = (part[0].copy() for part in asked())
    u = np.zeros((2, 2), np.float32)
    x[0, 0] = 500
    assert controller.call("hno_prepare", theta, controller.prepared) == 0
    assert controller.call("hno_control", controller.prepared, 1.0, x, u) == controller.codes["HNO_WARNING_STATE"]
    assert u.any()
    theta[0] = 9
    both = controller.codes["HNO_WARNING_STATE"] | controller.codes["HNO_WARNING_TYPE"]
    assert controller.call("hno_prepare", theta, controller.prepared) == controller.codes["HNO_WARNING_TYPE"]
    assert controller.call("hno_control", controller.prepared, 1.0, x, u) == both
    theta[0] = np.nan
    assert controller.call("hno_prepare", theta, controller.prepared) == controller.codes["HNO_ERROR_NOT_FINITE"]


def test_c_has_no_heap_and_no_state(exported) -> None:
    source = (exported(CASE, "c") / "hno_controller.c").read_text()
    assert not re.search(r"\b(malloc|calloc|realloc|free|alloca)\b", source)
    assert not re.search(r"^static (?!const|inline|int \w+\(|void \w+\()", source, re.MULTILINE)
    included = set(re.findall(r"#include [<\"](\S+)[>\"]", source))
    assert included == {"hno_controller.h", "math.h", "stddef.h", "string.h"}


@pytest.mark.skipif(shutil.which("cmake") is None, reason="there is no cmake")
def test_cmake_builds_the_example_loop(exported, tmp_path: Path) -> None:
    configure = ["cmake", "-S", str(exported(CASE, "c")), "-B", str(tmp_path)]
    for command in (configure, ["cmake", "--build", str(tmp_path)], [str(tmp_path / "example")]):
        ended = subprocess.run(command, capture_output=True, text=True, check=False)
        assert ended.returncode == 0, ended.stdout + ended.stderr
    assert "1500 steps; controls" in ended.stdout


@pytest.fixture(scope="module")
def module(exported) -> ModuleType:
    spec = importlib.util.spec_from_file_location("own_name", exported(CASE, "numpy") / "controller.py")
    assert spec is not None
    assert spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    return made


def test_the_file_for_numpy_needs_numpy_alone(exported) -> None:
    program = "import sys; sys.modules['torch'] = None; sys.path.insert(0, sys.argv[1]); import controller; "
    program += (
        "print(controller.control(controller.prepare([1, 1]), 2.0, [[20, 4, 0, 20]] * 2).shape, 'hno' in sys.modules)"
    )
    folder = str(exported(CASE, "numpy"))
    ended = subprocess.run([sys.executable, "-c", program, folder], capture_output=True, text=True, check=False)
    assert ended.stdout == "(2, 2) False\n", ended.stderr


def test_numpy_answers_one_state(module: ModuleType) -> None:
    found = wanted()
    for row, (tau, x, theta) in enumerate(zip(*asked(), strict=True)):
        u = module.control(module.prepare(theta), tau, x)
        np.testing.assert_allclose(u, found["control"][row], atol=1e-4)


@pytest.mark.parametrize(
    ("tau", "x", "theta", "message"),
    [
        (3.1, None, [1, 1], "horizon of 3"),
        (float("nan"), None, [1, 1], "horizon of 3"),
        (1.0, np.zeros((2, 3)), [1, 1], r"shape \(2, 4\); got \(2, 3\)"),
        (1.0, np.full((2, 4), np.nan), [1, 1], "finite"),
        (1.0, np.full((2, 4), 1e38), [1, 1], "no finite control"),
        (1.0, None, [1, 1, 1], "2 finite numbers"),
        (1.0, None, [1, np.inf], "2 finite numbers"),
    ],
)
def test_numpy_refuses(module: ModuleType, tau: float, x: np.ndarray | None, theta: list[float], message: str) -> None:
    state = asked()[1][0] if x is None else x
    with pytest.raises(ValueError, match=message), warnings.catch_warnings(action="ignore"):
        module.control(module.prepare(theta), tau, state)


def test_numpy_warns_once_outside_the_box(module: ModuleType) -> None:
    module._warned.clear()
    x, prepared = asked()[1][0] + 100, module.prepare([1, 1])
    with pytest.warns(UserWarning, match="outside the PDE box"):
        module.control(prepared, 1.0, x)
    with warnings.catch_warnings(action="error"):
        module.control(prepared, 1.0, x)


def test_the_onnx_model_says_what_it_is(exported) -> None:
    folder, game = exported(CASE, "onnx"), operator_of(CASE).game
    model = onnx.load(folder / "controller.onnx")
    onnx.checker.check_model(model, full_check=True)
    said = {entry.key: json.loads(entry.value) for entry in model.metadata_props}
    assert (said["game"], said["constants"], said["horizon"]) == ("narrow_road", {}, 3.0)
    assert said["type_box"] == [game.type_box.lo.tolist(), game.type_box.hi.tolist()]
    assert said["state_box"] == [game.state_box.lo.tolist(), game.state_box.hi.tolist()]
    assert said["units"]["tau"] == "s"
    assert said["version"]
    assert model.opset_import[0].version == OPSET
    assert [axis.dim_param for axis in model.graph.input[1].type.tensor_type.shape.dim] == ["batch", "", ""]


def test_the_halves_of_onnx_and_torch_are_the_whole_of_one_state(exported) -> None:
    found = wanted()["control"][:1]
    tau, x, theta = (part[:1] for part in asked())
    halves = [onnxruntime.InferenceSession(exported(CASE, "onnx") / f"{name}.onnx") for name in ("prepare", "control")]
    prepared = {f"prepared{k}": part for k, part in enumerate(halves[0].run(None, {"theta": theta}))}
    (u,) = halves[1].run(None, {**prepared, "tau": tau, "x": x})
    np.testing.assert_allclose(u, found, atol=1e-4)
    first, second = (
        torch.export.load(exported(CASE, "torch") / f"{name}.pt2").module() for name in ("prepare", "control")
    )
    (u,) = second(*first(torch.from_numpy(theta)), torch.from_numpy(tau), torch.from_numpy(x))
    np.testing.assert_allclose(u, found, atol=1e-4)
