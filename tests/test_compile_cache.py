"""Where compiled programs are kept, that they are found again, and how much of them."""

from __future__ import annotations

import os
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from jax.experimental.compilation_cache import compilation_cache

from carljax import compile_cache, config, evaluate, experiments, train
from carljax.compile_cache import OFF, VARIABLE

HITS = []


def _listen(event, **_):
    if event == "/jax/compilation_cache/cache_hits":
        HITS.append(event)


jax.monitoring.register_event_listener(_listen)


@pytest.fixture
def home(tmp_path, monkeypatch):
    """A user without settings of his own; afterwards the cache is as it was."""
    before = jax.config.jax_compilation_cache_dir
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    yield tmp_path
    jax.config.update("jax_compilation_cache_dir", before)
    compilation_cache.reset_cache()


def test_by_default_it_is_under_the_user_s_cache_folder(home):
    used = compile_cache.enable(None)
    assert used.parent == home / ".cache" / "carljax" / "xla"
    assert jax.config.jax_compilation_cache_dir == str(used)
    assert used.is_dir() and used.stat().st_mode & 0o077 == 0
    assert list(used.iterdir()) == []  # the trial leaves nothing


@pytest.mark.parametrize(("value", "counts"), [("/somewhere", True), ("here", False)])
def test_the_user_s_cache_folder_is_that_of_xdg_if_absolute(home, monkeypatch, value, counts):
    monkeypatch.setenv("XDG_CACHE_HOME", value)
    base = Path(value) if counts else home / ".cache"
    assert compile_cache.default_folder() == base / "carljax" / "xla"


def test_another_folder_is_taken_from_where_it_is_named(home, monkeypatch):
    monkeypatch.chdir(home)
    assert compile_cache.enable(Path("mine")).parent == home / "mine"
    assert compile_cache.absolute(Path("mine")) == home / "mine"
    assert compile_cache.absolute(None) is None and compile_cache.absolute(OFF) == OFF


@pytest.mark.parametrize("folder", [None, Path("mine")])
def test_the_variable_comes_first_and_its_folder_is_left_alone(home, monkeypatch, folder):
    before = jax.config.jax_compilation_cache_dir
    monkeypatch.setenv(VARIABLE, str(home / "theirs"))
    assert compile_cache.enable(folder) == home / "theirs"
    assert jax.config.jax_compilation_cache_dir == before  # JAX has read it when it was imported
    assert list(home.iterdir()) == []


def test_off_is_off(home):
    assert compile_cache.enable(None) is not None
    assert compile_cache.enable(OFF) is None
    assert jax.config.jax_compilation_cache_dir is None


def test_a_folder_that_cannot_be_written_is_said_in_a_line(home, capsys):
    (home / "file").touch()
    assert compile_cache.enable(home / "file" / "inside") is None
    assert jax.config.jax_compilation_cache_dir is None
    error = capsys.readouterr().err
    assert error.startswith("warning: ") and error.count("\n") == 1 and "inside" in error


def test_what_is_compiled_is_found_again(home):
    compile_cache.enable(home / "mine")
    x = jnp.arange(7.0)
    before = jax.config.jax_persistent_cache_min_compile_time_secs
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    try:
        for hits in (0, 1):
            HITS.clear()
            jax.jit(lambda x: jnp.sin(x) @ jnp.cos(x)).lower(x).compile()
            assert len(HITS) == hits
    finally:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", before)


def test_what_was_not_used_for_longest_goes(tmp_path):
    digest = "0123456789abcdef" * 4
    for age, name in enumerate(("old", "older", "oldest")):
        entry = tmp_path / f"jit_{name}-{digest}-cache"
        entry.write_bytes(bytes(100))
        os.utime(entry, (1e9 - age, 1e9 - age))
    (tmp_path / "not-an-entry-cache").write_bytes(bytes(1000))
    compile_cache.prune(tmp_path, 250)
    left = sorted(path.name.partition("-0")[0] for path in tmp_path.iterdir())
    assert left == ["jit_old", "jit_older", "not-an-entry-cache"]
    os.utime(tmp_path / f"jit_older-{digest}-cache", (2e9, 1e9))  # read again since
    compile_cache.prune(tmp_path, 100)
    assert [path.name[:9] for path in tmp_path.glob("jit_*")] == ["jit_older"]


def test_processors_of_other_kinds_have_folders_of_their_own(monkeypatch):
    here = compile_cache.machine_type()
    assert here == compile_cache.machine_type()
    text = "processor : 0\nmodel name : A\nflags : sse avx\ncpu MHz : 2000.1\n"

    def named(text):
        monkeypatch.setattr(Path, "read_text", lambda self, encoding: text)
        return compile_cache.machine_type()

    first = named(text)
    assert first == named(text.replace("2000.1", "3000.7").replace(": 0", ": 1"))
    assert (
        len({here, first, named(text.replace("avx", "avx512f")), named(text.replace("A", "B"))})
        == 4
    )


def test_every_command_that_compiles_asks_for_it(monkeypatch):
    asked = []

    def note(folder):
        asked.append(folder)
        raise config.ConfigError("enough")

    monkeypatch.setattr(compile_cache, "enable", note)
    assert train.main(["--run.compile-cache", "/a", "--run.dir", "/nowhere/run"]) == 2
    assert evaluate.main(["--planner", "idm", "--compile-cache", "off"]) == 2
    assert experiments.main(["epochs", "--preset", "cpu", "--dir", "/nowhere"]) == 2
    assert asked == [Path("/a"), OFF, None]
