"""Compilers for Numba that optimise a kernel once, together with all functions that it calls.

Numba by itself optimises and compiles every function with all that it calls, and repeats this in each of its callers.
`DeferredCompiler`, for functions that only kernels call, stops at LLVM's intermediate code. `WholeCompiler`, for the
kernel at the top, links all of them, each once, and optimises in one pass. The pass looks for no loops to vectorise,
because kernels work on vectors. Meshes are compiled Numba's way: as one program they ran at half the rate (17 for 36
rollouts a second).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
from numba import types
from numba.core.codegen import CPUCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import register_pass
from numba.core.typed_passes import NativeLowering, NopythonRewrites
from numba.core.untyped_passes import InlineClosureLikes

NEEDLESS = (NopythonRewrites, InlineClosureLikes)
"""Passes for expressions of arrays and for functions within functions, which kernels do not use."""


def _new_library(state: Any) -> CPUCodeLibrary:
    library = state.targetctx.codegen().create_library(state.func_id.func_qualname)
    library.enable_object_caching()
    library._optimize_functions = lambda module: setattr(module, "data_layout", library._codegen._data_layout)
    return library


def _link_all(library: CPUCodeLibrary) -> None:
    """Link all direct and indirect callees of a library once: a deferred library has linked nothing itself."""
    called: dict[CPUCodeLibrary, None] = {}
    waiting = list(library._linking_libraries)
    while waiting:
        other = waiting.pop()
        if other not in called:
            called[other] = None
            waiting.extend(other._linking_libraries)
    for other in called:
        library._final_module.link_in(CPUCodeLibrary._get_module_for_linking(other), preserve=True)
    library._linking_libraries = []


def _linked_module(library: CPUCodeLibrary) -> Any:
    """The module of a deferred library for one that Numba compiles its own way, which links its direct callees only."""
    if library._linking_libraries:
        _link_all(library)
        library._shared_module = None  # of earlier libraries
    return CPUCodeLibrary._get_module_for_linking(library)


def _finalize_linked(library: CPUCodeLibrary) -> None:
    _link_all(library)
    CPUCodeLibrary.finalize(library)


def _optimised_once(library: CPUCodeLibrary) -> None:
    """Run LLVM's passes on a library."""
    passes, options = library._codegen._module_pass_manager(loop_vectorize=False, slp_vectorize=False)
    passes.run(library._final_module, options)


@register_pass(mutates_CFG=True, analysis_only=False)
class DeferredLowering(NativeLowering):
    """Lowering without optimisation and machine code; the result can be called from other compiled functions only."""

    _name = "deferred_lowering"

    def run_pass(self, state: Any) -> bool:
        """See ``NativeLowering``."""
        state.library, state.flags.no_compile = _new_library(state), True
        library = state.library
        library.finalize = lambda: setattr(library, "_finalized", True)
        library._get_module_for_linking = lambda: _linked_module(library)
        super().run_pass(state)
        entry = object()  # by which Numba finds the function; it has no address
        state.targetctx.insert_user_function(entry, state.cr.fndesc, [state.library])
        state.cr = state.cr._replace(cfunc=entry)
        return True


@register_pass(mutates_CFG=True, analysis_only=False)
class WholeLowering(NativeLowering):
    """Lowering, optimisation and machine code of a function with all that was deferred."""

    _name = "whole_lowering"

    def run_pass(self, state: Any) -> bool:
        """See ``NativeLowering``."""
        state.library = library = _new_library(state)
        library._optimize_final_module = lambda: _optimised_once(library)
        library.finalize = lambda: _finalize_linked(library)
        return super().run_pass(state)


class DeferredCompiler(CompilerBase):
    """Numba's own pipeline, with another lowering."""

    lowering = DeferredLowering

    def define_pipelines(self) -> list:
        """See ``CompilerBase``."""
        pipeline = DefaultPassBuilder.define_nopython_pipeline(self.state)
        for index, (step, description) in enumerate(pipeline.passes):
            if step is NativeLowering:
                pipeline.passes[index] = self.lowering, description
        pipeline.passes = [item for item in pipeline.passes if item[0] not in NEEDLESS]
        pipeline.finalize()
        return [pipeline]


class WholeCompiler(DeferredCompiler):
    """Like `DeferredCompiler`, for the outermost kernel."""

    lowering = WholeLowering


def deferred(function: Callable, **options: bool) -> Callable:
    """A function that only kernels call, compiled once for every type and not for every number in a call."""
    dispatcher = numba.njit(no_cfunc_wrapper=True, _nrt=False, pipeline_class=DeferredCompiler, **options)(function)
    overloads, resolve = dispatcher.overloads, dispatcher.get_call_template
    dispatcher.add_overload = lambda result: overloads.update({tuple(result.signature.args): result})
    dispatcher.get_call_template = lambda arguments, named: resolve(tuple(map(types.unliteral, arguments)), named)
    return dispatcher


def whole(function: Callable, **options: Any) -> Callable:
    """The kernel at the top, which Python calls."""
    return numba.njit(pipeline_class=WholeCompiler, **options)(function)
