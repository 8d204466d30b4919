"""Names that libraries look for in objects that they are given, as far as they can be found."""

from __future__ import annotations

import builtins
import functools
import importlib.util
import re
import sysconfig
from collections.abc import Iterator
from pathlib import Path

_AGREED = re.compile(rb"(?<![A-Za-z0-9_])(__[a-z][a-z0-9_]*__|_[a-z][a-z0-9_]*_)(?![A-Za-z0-9_])")
_READ = ("numpy", "IPython", "torch/_tensor.py", "torch/overrides.py", "gymnasium", "cloudpickle")
_STANDARD = ("copy", "pickle", "copyreg", "inspect", "pprint", "abc", "typing", "dataclasses",
    "functools", "weakref", "reprlib", "json", "logging", "unittest", "pdb", "bdb", "traceback",
    "ctypes", "collections", "contextlib", "asyncio", "doctest", "pydoc", "enum", "numbers",
    "statistics", "fractions", "decimal", "operator", "types", "os", "io")  # fmt: skip
KNOWN = frozenset(
    {
        # numpy, its neighbours, and who exchanges arrays
        *("__array__", "__array_interface__", "__array_struct__", "__array_ufunc__"),
        *("__array_function__", "__array_finalize__", "__array_wrap__", "__array_prepare__"),
        *("__array_priority__", "__array_namespace__", "__array_api_version__"),
        *("__dlpack__", "__dlpack_device__", "__dlpack_c_exchange_api__", "__buffer__"),
        *("__cuda_array_interface__", "__sycl_usm_array_interface__", "__torch_function__"),
        *("__torch_dispatch__", "__tensor_flatten__", "__jax_array__", "__tf_tensor__"),
        *("__dataframe__", "__arrow_array__", "__arrow_c_array__", "__arrow_c_stream__"),
        *("__arrow_c_schema__", "__geo_interface__", "__dask_graph__", "_typ", "_mgr"),
        # copies and pickles
        *("__deepcopy__", "__copy__", "__reduce__", "__reduce_ex__", "__getstate__"),
        *("__setstate__", "__getnewargs__", "__getnewargs_ex__", "__getinitargs__", "__slots__"),
        *("__replace__", "_asdict", "_fields", "_make", "_replace"),
        # what shows things
        *("_repr_html_", "_repr_markdown_", "_repr_svg_", "_repr_png_", "_repr_jpeg_"),
        *("_repr_pdf_", "_repr_latex_", "_repr_json_", "_repr_javascript_", "_repr_pretty_"),
        *("_repr_mimebundle_", "_ipython_display_", "_ipython_key_completions_"),
        *("_ipython_canary_method_should_not_exist_", "_jupyter_messages", "_jupyter_nbextension"),
        *("__html__", "__html_format__", "__rich__", "__rich_console__", "__rich_measure__"),
        *("__rich_repr__", "__pt_repr__", "__pretty__", "__repr_args__", "__prettyprint__"),
        *("__ipython_display__", "_display_", "_mime_", "_latex", "_sympystr", "getdoc"),
        # computer algebra and numbers
        *("_sympy_", "_sage_", "_mpmath_", "_mpf_", "_mpi_", "_mpc_", "_symengine_", "__index__"),
        # the interpreter's own and what tests and debuggers look for
        *("__fspath__", "__wrapped__", "__signature__", "__text_signature__", "__doc__"),
        *("__class__", "__dict__", "__weakref__", "__dir__", "__module__", "__name__"),
        *("__annotations__", "__type_params__", "__origin__", "__args__", "__parameters__"),
        *("__mro_entries__", "__isabstractmethod__", "__abstractmethods__", "_abc_impl"),
        *("_abc_cache", "_abc_registry", "_as_parameter_", "__ctypes_from_outparam__"),
        *("_pytestfixturefunction", "_mock_methods", "__tracebackhide__", "__pydevd_repr__"),
        *("__bytes__", "__complex__", "__float__", "__int__", "__trunc__", "__length_hint__"),
        *("__del__", "__enter__", "__exit__", "__await__", "__aiter__", "__missing__"),
        *("__pydantic_validator__", "__get_pydantic_core_schema__", "__attrs_attrs__", "__json__"),
        # Gymnasium's, and ours
        *("np_random", "_np_random", "_np_random_seed", "envs", "env_fns", "env", "unwrapped"),
        *("_session", "_requests", "_manifest", "_timeouts", "_read_actions"),
        *("reset", "step", "close", "render", "spec", "metadata", "fileno", "keys", "mro"),
    }
)


@functools.cache
def names_that_libraries_call() -> tuple[str, ...]:
    """The list above, and each name of that form in the sources of what is installed."""
    found = set(KNOWN)
    for kind in vars(builtins).values():
        found |= {name for name in dir(kind) if name.startswith("_")}
    for source in _sources():
        found |= {name.decode() for name in _AGREED.findall(source)}
    return tuple(sorted(found))


def _sources() -> Iterator[bytes]:
    standard = Path(sysconfig.get_path("stdlib"))
    for name in _STANDARD:
        file, folder = standard / f"{name}.py", standard / name
        for path in [file] if file.exists() else sorted(folder.glob("*.py")):
            yield path.read_bytes()
    for name in _READ:
        package, _, inner = name.partition("/")
        spec = importlib.util.find_spec(package)
        if spec is None or spec.origin is None:
            continue
        root = Path(spec.origin).parent
        suffixes = {".py", ".so", ".pyi"}
        files = [root / inner] if inner else sorted(root.rglob("*"))
        yield from (path.read_bytes() for path in files if path.suffix in suffixes)
