"""Exported controllers of every kind behind one interface. Loading one runs it: it is a program, not data.

What one kind alone needs is imported there, which keeps the import of this package below 30 ms.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import numpy as np

from hno.runtime.artefact import Artefact, ArtefactError, Many, read_manifest

if TYPE_CHECKING:
    import ctypes
    from types import CodeType

    from numpy.typing import ArrayLike, NDArray

    Reals = NDArray[np.float32]


def load(folder: str | Path) -> Artefact:
    """Open the controller in a folder that `hno export` wrote; one in C is compiled first.

    Its code runs with your rights: load what you or somebody whom you trust has exported. Checksums detect damage, not
    malice.

    Raises:
        ArtefactError: see `read_manifest`; or what it needs is missing here: a compiler, onnxruntime, torch.
    """
    about = read_manifest(folder)
    kinds: dict[str, Callable[[Mapping[str, Any], Path], Artefact]] = {
        "numpy": _NumPy,
        "c": _C,
        "onnx": _ONNX,
        "torch": _Torch,
    }
    if about.get("kind") not in kinds:
        raise ArtefactError(f"{folder} is of the kind {about.get('kind')!r:.20}; known are {', '.join(kinds)}.")
    return kinds[about["kind"]](about, Path(folder))


@final
class _NumPy(Artefact):
    def __init__(self, about: Mapping[str, Any], folder: Path) -> None:
        import importlib.machinery
        import importlib.util

        class Verified(importlib.machinery.SourceFileLoader):
            """Of sources alone."""

            def get_code(self, fullname: str) -> CodeType:
                """Of the file that was verified, not of a `__pycache__` beside it; and none is left."""
                return self.source_to_code(self.get_data(self.path), self.path)

        super().__init__(about)
        loader = Verified("hno_exported_controller", str(folder / "controller.py"))
        spec = importlib.util.spec_from_loader(loader.name, loader)
        assert spec is not None
        self._module = importlib.util.module_from_spec(spec)
        loader.exec_module(self._module)

    def _answers(self, tau: Reals, x: Reals, theta: Reals) -> dict[str, Reals]:
        if len(tau) > 1:
            return dict(self._module.batch(tau, x, theta))
        found = self._module._everything1(self._module._prepare1(theta), tau, x)
        return dict(zip(self._module.OUTPUTS, found, strict=True))


_GLUE = """
#include "hno_controller.h"
#include <math.h>
#include <stddef.h>
int glue_prepared(void) { return (int)sizeof(hno_prepared); }
int glue_prepare(int count, const float *theta, hno_prepared *prepared)
{
    int worst = 0;
    for (int k = 0; k < count && worst >= 0; k++) {
        const int code = hno_prepare(theta + k * HNO_PLAYERS, &prepared[k]);
        worst = code < 0 ? code : worst | code;
    }
    return worst;
}
int glue_answers(int count, const int *which, const hno_prepared *prepared, const float *tau, const float *x,
                 hno_answer *answers)
{
    int worst = 0;
    for (int k = 0; k < count && worst >= 0; k++) {
        int code = hno_everything(&prepared[which[k]], tau[k], x + k * HNO_PLAYERS * HNO_STATES, &answers[k]);
        if (code == HNO_ERROR_NOT_FINITE) { /* the question is: there is no answer */
            float *entries = (float *)&answers[k];
            for (size_t entry = 0; entry < sizeof(hno_answer) / sizeof(float); entry++) entries[entry] = NAN;
            code = HNO_WARNING_STATE;
        }
        worst = code < 0 ? code : worst | code;
    }
    return worst;
}
"""


@final
class _C(Artefact):
    def __init__(self, about: Mapping[str, Any], folder: Path) -> None:
        super().__init__(about)
        self._library = _compiled(folder)

    def _answers(self, tau: Reals, x: Reals, theta: Reals) -> dict[str, Reals]:
        types, which = np.unique(theta, axis=0, return_inverse=True)
        index = np.ascontiguousarray(which.reshape(-1), np.int32)
        prepared = np.zeros((len(types), self._library.glue_prepared()), np.uint8)
        self._call("glue_prepare", len(types), np.ascontiguousarray(types), prepared)
        sizes = {name: int(np.prod(shape)) for name, shape in self.about["outputs"].items()}
        found = np.zeros((len(tau), sum(sizes.values())), np.float32)
        self._call("glue_answers", len(tau), index, prepared, tau, x, found)
        parts = np.split(found, np.cumsum(list(sizes.values()))[:-1], axis=1)
        shapes = self.about["outputs"].items()
        return {name: part.reshape(-1, *shape) for (name, shape), part in zip(shapes, parts, strict=True)}

    def _many(self, theta: Reals) -> Many:
        return _ManyInC(self, theta, self._library)

    def _call(self, name: str, count: int, *arrays: NDArray[Any]) -> None:
        _accepted(getattr(self._library, name)(count, *map(_pointer, arrays)))


@final
class _ManyInC(Many):
    """What types do not change is computed once for all of them, and what they alone determine once for all states."""

    def __init__(self, artefact: Artefact, theta: Reals, library: ctypes.CDLL) -> None:
        import ctypes

        super().__init__(artefact, theta)
        about, self._library, self._real = artefact.about, library, ctypes.c_float
        self._prepared = np.zeros((len(theta), library.glue_prepared()), np.uint8)
        self._states = about["players"], about["states"]
        self._controls = np.zeros((len(theta), about["players"], about["controls"]), np.float32)
        self._to = _pointer(self._prepared), _pointer(self._controls)
        _accepted(library.glue_prepare(len(theta), _pointer(theta), self._to[0]))

    def replace(self, row: int, theta: NDArray[Any]) -> None:
        """As `Many`."""
        super().replace(row, theta)
        _accepted(self._library.glue_prepare(1, _pointer(self._theta[row]), _pointer(self._prepared[row])))

    def __call__(self, tau: float, x: ArrayLike) -> Reals:
        """As `Many`."""
        state, (prepared, controls) = np.ascontiguousarray(x, np.float32), self._to
        if state.shape != self._states:
            raise ValueError(f"Expected one state of shape {self._states}; got {state.shape}.")
        found = len(self._prepared), self._real(tau), _pointer(state), None, None, controls
        _accepted(self._library.hno_many_types(prepared, *found))
        return self._controls.copy()


def _accepted(code: int) -> None:
    if code < 0:
        raise ValueError(f"The controller refused with code {code}; see hno_controller.h.")


def _pointer(array: NDArray[Any]) -> ctypes.c_void_p:
    import ctypes

    return ctypes.c_void_p(array.ctypes.data)


def _compiled(folder: Path) -> ctypes.CDLL:
    """The shared library of a controller in C, in memory: its file is gone."""
    import ctypes
    import shutil
    import subprocess
    import tempfile

    names = [os.environ.get("CC", "cc"), "gcc", "clang"]
    compiler = next((found for name in names if (found := shutil.which(name))), None)
    if compiler is None:
        raise ArtefactError(
            f"{folder} is in C, and there is no compiler: none of {', '.join(names)}. Install one, or set CC."
        )
    with tempfile.TemporaryDirectory() as made:
        library, glue = Path(made) / "controller.so", Path(made) / "glue.c"
        glue.write_text(_GLUE, encoding="utf-8")
        flags = ["-std=c99", "-O3", "-shared", "-fPIC", f"-I{folder.absolute()}", "-o", str(library)]
        sources = [str(folder.absolute() / "hno_controller.c"), str(glue), "-lm"]
        ended = subprocess.run([compiler, *flags, *sources], capture_output=True, text=True, check=False)
        if ended.returncode:
            raise ArtefactError(f"{compiler} cannot compile {folder}: {ended.stderr.strip()[:500]}")
        return ctypes.CDLL(str(library))


@final
class _ONNX(Artefact):
    def __init__(self, about: Mapping[str, Any], folder: Path) -> None:
        super().__init__(about)
        try:
            import onnxruntime
        except ImportError as error:
            raise ArtefactError(f"{folder} needs onnxruntime: pip install onnxruntime") from error
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        self._session = onnxruntime.InferenceSession(
            str(folder / "controller.onnx"), options, providers=["CPUExecutionProvider"]
        )

    def _answers(self, tau: Reals, x: Reals, theta: Reals) -> dict[str, Reals]:
        names = list(self.about["outputs"])
        return dict(zip(names, self._session.run(names, {"tau": tau, "x": x, "theta": theta}), strict=True))


@final
class _Torch(Artefact):
    def __init__(self, about: Mapping[str, Any], folder: Path) -> None:
        super().__init__(about)
        file = folder / "controller.pt2"
        _refuse_pickles(file)
        try:
            import torch
        except ImportError as error:
            raise ArtefactError(f"{folder} needs torch: pip install torch") from error
        self._module = torch.export.load(file).module(check_guards=False)

    def _answers(self, tau: Reals, x: Reals, theta: Reals) -> dict[str, Reals]:
        import torch

        with torch.inference_mode():
            found = self._module(*map(torch.from_numpy, (tau, x, theta)))
        return {name: part.numpy() for name, part in zip(self.about["outputs"], found, strict=True)}


def _refuse_pickles(file: Path) -> None:
    """torch.export.load would unpickle what an archive says is pickled; those of `hno export` say so of nothing."""
    import zipfile

    with zipfile.ZipFile(file) as archive:
        configs = [name for name in archive.namelist() if name.endswith("_config.json")]
        entries = [entry for name in configs for entry in json.loads(archive.read(name))["config"].values()]
        if any(entry.get("use_pickle") is not False for entry in entries):
            raise ArtefactError(f"{file} holds pickled objects, which could run anything: it was not written by hno.")
