"""Compiled programs kept on disk, so that the same training starts without compiling again.

JAX's persistent compilation cache does the work. It names an entry after the program, its options
and flags, the versions of jaxlib and of the backend, and the devices: an entry that does not fit is
never found, only left behind. Two things it leaves open are seen to here. It does not say for which
processor XLA:CPU has compiled, and code for a newer one is loaded and may end in an illegal
instruction; so each type of processor has a folder of its own, as home directories are shared. And
it grows for ever unless a further package is installed, so what has not been used for longest goes.
"""

from __future__ import annotations

import hashlib
import os
import platform
import re
import sys
import tempfile
from pathlib import Path
from typing import Annotated

import jax
import tyro
from jax.experimental.compilation_cache import compilation_cache

VARIABLE = "JAX_COMPILATION_CACHE_DIR"
OFF = Path("off")
MAX_BYTES = 4 << 30  # kept of each type of processor; an entry has some MB
_ENTRY = re.compile(r".+-[0-9a-f]{64}-cache")

# The type of a command line's field.
CacheFolder = Annotated[Path | None, tyro.conf.arg(metavar="DIR|off")]


def enable(folder: Path | None) -> Path | None:
    """Turns the cache on or off for this process, before anything is compiled.

    Where the user has set the variable JAX_COMPILATION_CACHE_DIR, that folder is used as it is. A
    folder that can't be written is no reason not to run: it is said in a line on stderr.

    Args:
      folder: where to keep it; None for the user's cache folder, `OFF` for no cache.

    Returns:
      The folder in use, or None without one.
    """
    if folder == OFF:
        _use(None)
        return None
    if VARIABLE in os.environ:
        return Path(os.environ[VARIABLE]) if os.environ[VARIABLE] else None
    try:
        path = (absolute(folder) or default_folder()) / machine_type()
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
        prune(path, MAX_BYTES)
    except (OSError, RuntimeError) as error:
        print(f"warning: compiling without a cache on disk: {error}", file=sys.stderr)
        _use(None)
        return None
    _use(path)
    return path


def absolute(folder: Path | None) -> Path | None:
    """The same folder wherever it is named from; None and `OFF` stay what they are."""
    return folder if folder in (None, OFF) else Path(folder).resolve()


def default_folder() -> Path:
    """The user's cache folder for compiled programs.

    Raises:
      RuntimeError: the user has no home directory.
    """
    base = Path(os.environ.get("XDG_CACHE_HOME", ""))
    # source: XDG Base Directory Specification: paths that are not absolute are to be ignored
    return (base if base.is_absolute() else Path.home() / ".cache") / "carljax" / "xla"


def machine_type() -> str:
    """A name for what code for this processor may use; equal names can run each other's code."""
    kind = platform.machine() or "unknown"
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    # As x86 and ARM call them; both the model, by which code is tuned, and what it can do.
    names = ("vendor_id", "cpu family", "model", "model name", "flags", "Features", "CPU part")
    found = {line for line in lines if line.partition(":")[0].strip() in names}
    text = "\n".join(sorted(found)) or platform.processor()
    return f"{kind}-{hashlib.sha256(text.encode()).hexdigest()[:12]}"


def prune(path: Path, max_bytes: int) -> None:
    """Deletes what has not been used for longest, until the rest is small enough.

    Args:
      path: folder of the cache; other files in it are left alone.
      max_bytes: of the entries that may stay.
    """
    entries = [entry for entry in path.iterdir() if _ENTRY.fullmatch(entry.name)]
    kept = 0
    for entry, stat in sorted(_stats(entries), key=lambda pair: -_used(pair[1])):
        kept += stat.st_size
        if kept > max_bytes:
            entry.unlink(missing_ok=True)


def _stats(entries: list[Path]) -> list[tuple[Path, os.stat_result]]:
    """Those that are still there: another process may prune at the same time."""
    found = []
    for entry in entries:
        try:
            found.append((entry, entry.stat()))
        except FileNotFoundError:
            continue
    return found


def _used(stat: os.stat_result) -> float:
    """When a file was last read, as far as its file system notes that, or else written."""
    return max(stat.st_atime, stat.st_mtime)


def _use(path: Path | None) -> None:
    """Tells JAX, and makes it look again if it has looked before."""
    wanted = None if path is None else str(path)
    if jax.config.values["jax_compilation_cache_dir"] != wanted:
        jax.config.update("jax_compilation_cache_dir", wanted)
        compilation_cache.reset_cache()
