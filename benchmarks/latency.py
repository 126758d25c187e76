"""How long an exported controller takes: `python benchmarks/latency.py [RUN|CHECKPOINT] [CALLS]`.

One thread, one state that moves a little, types that stay as they are, so what they determine is prepared: median, p99
and p99.9 of each call in microseconds, beside a loop that calls nothing; "belief" is one step of `hno.runtime.Believer`
with 625 candidates, which acts on their mean and learns from what it sees. Then states per second in batches, and what
`import hno.runtime` adds to NumPy's own import. Without a checkpoint it is the default operator of narrow_road with
random weights, which takes as long. The last line is JSON; its torch is the exported program.
"""

from __future__ import annotations

import gc
import importlib.util
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import torch

from hno.control import Feedback
from hno.export.trace import points
from hno.games import make
from hno.operators import Architecture, Choice, make_operator
from hno.runtime import Believer, load
from hno.training.checkpoint import load_policy

BATCHES = 1, 64, 4096
MILLION = 1_000_000
TYPES = 625
FLAGS = ["-std=c99", "-O3"]
TIMED = """
#define _POSIX_C_SOURCE 199309L
#include "hno_controller.h"
#include <stdio.h>
#include <time.h>
static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return 1e6 * t.tv_sec + 1e-3 * t.tv_nsec;
}
static hno_prepared prepared[@TYPES@];
static float many[@TYPES@ * HNO_PLAYERS * HNO_CONTROLS];
static const float theta[] = {@THETA@};
static float x[] = {@STATE@}, u[HNO_PLAYERS * HNO_CONTROLS];
#define TIME(name, calls, call) for (long k = 0; k < calls; k++) { \\
    x[0] += 1e-6f; const double begin = now(); call; printf(name " %.3f\\n", now() - begin); }
int main(void)
{
    for (int k = 0; k < @TYPES@; k++) hno_prepare(theta, &prepared[k]);
    TIME("nothing", @CALLS@, (void)0)
    TIME("control", @CALLS@, hno_control(prepared, 1.0f, x, u))
    TIME("recomputed", @CALLS@, (hno_prepare(theta, prepared), hno_control(prepared, 1.0f, x, u)))
    TIME("types", @CALLS@ / 100, hno_many_types(prepared, @TYPES@, 1.0f, x, 0, 0, many))
    return 0;
}
"""


def main(path: str | None, calls: int) -> None:
    """Measure, and print."""
    torch.set_num_threads(1)
    policy = Feedback(_stand_in()) if path is None else load_policy(path)
    found: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as made:
        folders = {kind: policy.export(kind, Path(made) / kind) for kind in ("c", "numpy", "onnx", "torch")}
        print(f"{'us':<44}{'median':>9}{'p99':>9}{'p99.9':>9}")
        for name, times in _in_c(folders["c"], policy, calls, Path(made)).items():
            found[name] = _row(name, times)
        for name, call in _in_python(folders, policy).items():
            found[name] = _row(name, _timed(call, calls // 20 if name.startswith("PyTorch policy") else calls))
        beliefs = {kind: _timed(_believing(folders[kind], policy), calls // 100) for kind in ("c", "numpy")}
        for kind, times in beliefs.items():
            _row(f"belief over {TYPES} types, {kind}", times)
        print(f"\n{'states a second, in batches of':<44}" + "".join(f"{size:>9}" for size in BATCHES))
        for kind, folder in folders.items():
            _throughput(kind, load(folder).answers, policy)
        _throughput("PyTorch policy", policy.act, policy)
    print(f"\nimport hno.runtime, after numpy: {min(_import_ms() for _ in range(5)):.1f} ms")
    if torch.cuda.is_available():
        _on_gpu(policy)
    names = {"c_p99_us": "C, prepared", "numpy_p99_us": "NumPy, prepared", "onnx_p99_us": "ONNX, prepared",
             "torch_p99_us": "torch program, eager, prepared"}  # fmt: skip
    rates = {f"belief_{kind}_hz": round(1e6 / float(np.median(times))) for kind, times in beliefs.items()}
    print(json.dumps({key: round(found[name], 2) for key, name in names.items()} | rates))


def _stand_in() -> Any:
    torch.manual_seed(0)
    operator = make_operator(make("narrow_road"), Architecture(Choice("potential")))
    operator.value_scale.fill_(40.0)
    return operator.eval().requires_grad_(False)


def _question(policy: Feedback, size: int = 1) -> list[torch.Tensor]:
    return [part.float() for part in points(policy.game, size, 0).values()]


def _in_c(folder: Path, policy: Feedback, calls: int, made: Path) -> dict[str, list[float]]:
    _, x, theta = _question(policy)
    words = {"@TYPES@": str(TYPES), "@CALLS@": str(calls), "@THETA@": _listed(theta), "@STATE@": _listed(x)}
    text = TIMED
    for word, value in words.items():
        text = text.replace(word, value)
    (made / "timed.c").write_text(text)
    program = str(made / "timed")
    sources = [str(made / "timed.c"), str(folder / "hno_controller.c")]
    subprocess.run(["cc", *FLAGS, f"-I{folder}", *sources, "-lm", "-o", program], check=True)
    names = {"nothing": "C, nothing", "control": "C, prepared", "recomputed": "C, types prepared at every call",
             "types": f"C, {TYPES} types at one state"}  # fmt: skip
    times: dict[str, list[float]] = {name: [] for name in names.values()}
    for line in subprocess.run([program], capture_output=True, text=True, check=True).stdout.splitlines():
        name, spent = line.split()
        times[names[name]].append(float(spent))
    return times


def _listed(part: torch.Tensor) -> str:
    return ", ".join(f"{float(entry):.9g}f" if entry % 1 else f"{float(entry):.1f}f" for entry in part.flatten())


def _in_python(folders: dict[str, Path], policy: Feedback) -> dict[str, Callable[[], object]]:
    tau, x, theta = _question(policy)
    arrays = [part.numpy() for part in (tau, x, theta)]
    spec = importlib.util.spec_from_file_location("controller", folders["numpy"] / "controller.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    prepared, time_to_go, state = module.prepare(arrays[2][0]), float(tau), arrays[1][0]
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    whole, first, second = (
        onnxruntime.InferenceSession(folders["onnx"] / f"{name}.onnx", options)
        for name in ("controller", "prepare", "control")
    )
    feed = {f"prepared{k}": part for k, part in enumerate(first.run(None, {"theta": arrays[2]}))}
    feed |= {"tau": arrays[0], "x": arrays[1]}
    asked = dict(zip(("tau", "x", "theta"), arrays, strict=True))
    before, after, program = (
        torch.export.load(folders["torch"] / f"{name}.pt2").module(check_guards=False)
        for name in ("prepare", "control", "controller")
    )
    given = before(theta)
    return {
        "Python, nothing": lambda: None,
        "NumPy, prepared": lambda: module.control(prepared, time_to_go, state),
        "ONNX, prepared": lambda: second.run(None, feed),
        "ONNX, everything": lambda: whole.run(None, asked),
        "torch program, eager, prepared": lambda: after(*given, tau, x),
        "torch program, eager, everything": lambda: program(tau, x, theta),
        "PyTorch policy, as trained": lambda: policy.act(tau, x, theta),
    }


def _believing(folder: Path, policy: Feedback) -> Callable[[], object]:
    """One step of the first player: it acts, and learns from what all do."""
    tau, x, theta = (part[0].numpy() for part in _question(policy))
    box = policy.game.type_box
    types = np.tile(theta, (TYPES, 1))
    types[:, 1] = np.linspace(float(box.lo[1]), float(box.hi[1]), TYPES)
    player, seen = Believer(load(folder), 0, types), policy.act(tau, x, theta)
    return lambda: (player.act(float(tau), x), player.observe(seen, 0.002))


def _timed(call: Callable[[], object], calls: int) -> list[float]:
    """Microseconds of each call, without garbage collection."""
    times, clock = [0.0] * calls, time.perf_counter
    for _ in range(20):
        call()
    gc.disable()
    with torch.inference_mode():
        for k in range(calls):
            begin = clock()
            call()
            times[k] = 1e6 * (clock() - begin)
    gc.enable()
    return times


def _row(name: str, times: list[float]) -> float:
    """Print one; its p99."""
    middle, high, higher = np.percentile(times, [50, 99, 99.9])
    print(f"{name:<44}{middle:>9.2f}{high:>9.2f}{higher:>9.2f}", flush=True)
    return float(high)


def _throughput(name: str, answer: Callable[..., object], policy: Feedback) -> None:
    rates = []
    for size in BATCHES:
        asked = _question(policy, size)
        given = asked if name == "PyTorch policy" else [part.numpy() for part in asked]
        spent = min(_timed(lambda given=given: answer(*given), 10))  # type: ignore[misc]  # mypy infers no lambda's type
        rates.append(1e6 * size / spent)
    print(f"{name:<44}" + "".join(f"{rate:>9.0f}" for rate in rates), flush=True)


def _import_ms() -> float:
    program = "import numpy, time; t = time.perf_counter(); import hno.runtime; print(1e3 * (time.perf_counter() - t))"
    return float(subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout)


def _on_gpu(policy: Feedback) -> None:
    asked = [part.cuda() for part in _question(policy, MILLION)]
    there = Feedback(policy.operator.cuda(), checked=False)

    def call() -> None:
        there.act(*asked)
        torch.cuda.synchronize()

    print(f"PyTorch policy on {torch.cuda.get_device_name()}, {MILLION} states: {min(_timed(call, 5)) / 1e3:.1f} ms")


if __name__ == "__main__":
    words = sys.argv[1:]
    count = int(words.pop()) if words and words[-1].isdigit() else 100_000
    main(words[0] if words else None, count)
