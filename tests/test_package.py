"""The promises around the code: README command, notebooks without outputs, one version."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

import carljax

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


def test_ci_runs_the_test_command_that_the_readme_gives():
    # The pattern in .ci/run has to find that command, and nothing before it.
    pattern = re.search(r"grep -m 1 '(.*)' README\.md", (ROOT / ".ci" / "run").read_text())
    assert pattern is not None
    lines = (ROOT / "README.md").read_text().splitlines()
    found = [line for line in lines if re.search(pattern[1], line)]
    assert found[:1] == ['pip install -e ".[test]" && pytest']


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_notebooks_are_kept_without_outputs(path):
    for cell in json.loads(path.read_text())["cells"]:
        assert not cell.get("outputs"), cell["source"]
        assert cell.get("execution_count") is None, cell["source"]


def test_the_changelog_is_about_this_version_or_what_comes_next():
    text = (ROOT / "CHANGELOG.md").read_text()
    assert "## Unreleased" in text or f"## {carljax.__version__}" in text
