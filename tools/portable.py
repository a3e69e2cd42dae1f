"""The numerical tests with other instruction sets than this processor's own: what fails here fails on another machine.

Every library chooses its code by the processor it finds: sums come in another order, the last bits differ, and a
learning curve or a chain of samples soon differs altogether. A test that rests on one of them passes on one chip only.
Each setting is looked for in what the libraries then do before its tests are run. x86-64 only.

    python tools/portable.py [PATH ...] [-- OPTIONS OF PYTEST]
"""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOMS = ("policies", "prediction", "discrepancy", "inference", "bayes", "simulators", "fem")
"""The rooms that compute; others read, write and print."""

# Without a list of features Numba would take the name, and this processor's features with it.
NUMBA = {"NUMBA_CPU_NAME": "x86-64-v3", "NUMBA_CPU_FEATURES": ""}
SETTINGS: dict[str, dict[str, str]] = {
    "avx2": {
        "ATEN_CPU_CAPABILITY": "avx2",
        "ONEDNN_MAX_CPU_ISA": "AVX2",
        "XLA_FLAGS": "--xla_cpu_max_isa=AVX2",
        "OPENBLAS_CORETYPE": "Haswell",
        **NUMBA,
    },
    # Numba stays at AVX2: its kernels fuse multiplication and addition, which older processors do in software.
    "default": {
        "ATEN_CPU_CAPABILITY": "default",
        "ONEDNN_MAX_CPU_ISA": "SSE41",
        "XLA_FLAGS": "--xla_cpu_max_isa=SSE4_2",
        "OPENBLAS_CORETYPE": "Nehalem",
        **NUMBA,
    },
}
RUN_IN = {"avx2": ROOMS, "default": ("policies",)}
"""Rooms of a setting: only PyTorch is as slow as "default" on machines that are in use, where a wheel has no better."""

NUMPY_OFF = {"avx2": ("AVX512", "X86_V4"), "default": ("AVX", "FMA", "F16C", "X86_V3", "X86_V4")}
"""What the names of NumPy's extensions begin with that a setting turns off."""
REGISTERS = {"avx2": ("zmm", "%k"), "default": ("zmm", "ymm", "%k")}
"""What machine code of a setting never has."""


def found_by_numpy() -> list[str]:
    """Extensions of the instruction set that NumPy uses."""
    import numpy as np

    return list(np.show_config(mode="dicts")["SIMD Extensions"].get("found", []))


def environment(setting: str) -> dict[str, str]:
    """Variables of a setting. NumPy warns of a name that the processor does not have."""
    off = [name for name in found_by_numpy() if name.startswith(NUMPY_OFF[setting])]
    return {**os.environ, **SETTINGS[setting], **({"NPY_DISABLE_CPU_FEATURES": " ".join(off)} if off else {})}


def machine_code(folder: str) -> str:
    """What XLA compiles a small program to, disassembled; nothing where there is no objdump."""
    os.environ["XLA_FLAGS"] += f" --xla_dump_to={folder}"
    os.environ["JAX_ENABLE_COMPILATION_CACHE"] = "false"
    import jax

    # A cast that saturates compares and selects: with AVX-512, by mask registers.
    jax.block_until_ready(jax.jit(lambda x: x.astype("int32") * 3)(jax.numpy.ones(4096, "float32")))
    objdump = shutil.which("objdump")
    objects = sorted(Path(folder).glob("*jit__lambda*.o"))
    if not objects:
        raise SystemExit("XLA wrote no machine code: see its flag --xla_dump_to")
    return "".join(subprocess.check_output([objdump, "-d", path], text=True) for path in objects) if objdump else ""


def check(setting: str) -> None:
    """Exit with what the libraries of this process do otherwise than the setting says."""
    with tempfile.TemporaryDirectory() as folder:
        code = machine_code(folder)
    import numba
    import torch
    from numba.core.registry import cpu_target
    from threadpoolctl import threadpool_info

    from rfdropo_bayes.fem.native.simd import vector_width

    wanted = SETTINGS[setting]
    add = numba.njit("float64[:](float64[:], float64[:])")(lambda a, b: a + b)
    kinds = {info["architecture"] for info in threadpool_info() if info["internal_api"] == "openblas"}
    wrong = {
        "PyTorch": torch.backends.cpu.get_cpu_capability() != wanted["ATEN_CPU_CAPABILITY"].upper(),
        "XLA": any(register in code for register in REGISTERS[setting]),
        "OpenBLAS": kinds != {wanted["OPENBLAS_CORETYPE"]},
        "NumPy": any(name.startswith(NUMPY_OFF[setting]) for name in found_by_numpy()),
        "Numba": cpu_target.target_context.codegen().magic_tuple()[1:] != (wanted["NUMBA_CPU_NAME"], ""),
        "Numba's code": any("zmm" in assembly for assembly in add.inspect_asm().values()),
        "lanes of the kernels": vector_width() != 32,
    }
    if any(wrong.values()):
        raise SystemExit(f"{setting} does not reach {', '.join(name for name, missed in wrong.items() if missed)}")
    print(
        f"{setting}: reaches {', '.join(wrong)}{'' if code else ' (XLA: not looked at, without objdump)'}", flush=True
    )


def main(arguments: list[str]) -> int:
    """Check and run every setting; 1 if a test failed in one of them."""
    if platform.machine() not in ("x86_64", "AMD64"):
        print(f"nothing to run: {platform.machine()} is not x86-64", file=sys.stderr)
        return 0
    split = arguments.index("--") if "--" in arguments else len(arguments)
    rooms, options = [Path(path).name for path in arguments[:split]] or list(ROOMS), arguments[split + 1 :]
    failed = []
    for setting in SETTINGS:
        variables = environment(setting)
        subprocess.run([sys.executable, __file__, "--check", setting], env=variables, check=True)
        paths = [f"tests/{room}" for room in rooms if room in RUN_IN[setting]]
        command = [sys.executable, "-m", "pytest", "-m", "not slow and not notebook", *options, *paths]
        if paths and subprocess.run(command, env=variables).returncode:
            failed.append(setting)
    if failed:
        print(f"tests fail with other instruction sets: {', '.join(failed)}", file=sys.stderr)
    return bool(failed)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--check"]:
        check(sys.argv[2])
    else:
        raise SystemExit(main(sys.argv[1:]))
