"""What is released: metadata, workflow, recipe and container, and the names that the distribution installs."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import yaml

import ocp
from ocp.__main__ import main

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
WORKFLOW = yaml.safe_load((ROOT / ".github/workflows/release.yml").read_text(encoding="utf-8"))
HOST = "example.org"
PLACEHOLDER = f"https://{HOST}/selfmotion"
CHANGES = "## [1.2.0] - 2030-01-31\n"
CONDA_NAMES = {"matplotlib": "matplotlib-base"}  # without the Qt libraries that conda's matplotlib brings


def run(folder: Path, *words: str, **variables: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": str(ROOT)} | variables
    return subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True, timeout=60, check=False)


def test_the_address_of_the_project_is_stated_once() -> None:
    assert list(PROJECT["project"]["urls"]) == ["Repository"]
    address = PROJECT["project"]["urls"]["Repository"]
    texts = [(ROOT / name).read_text(encoding="utf-8") for name in ("README.md", "CITATION.cff", "docs/conf.py")]
    assert not [text for text in texts if address in text]


def test_command_and_module_run_the_same_function() -> None:
    module, _, function = PROJECT["project"]["scripts"]["selfmotion"].partition(":")
    assert getattr(import_module(module), function) is main
    assert module == "ocp.__main__"


@pytest.mark.parametrize("script", ["from ocp import plan", "import models\nimport ocp.app.files"])
@pytest.mark.parametrize("name", ["models.py", "models/__init__.py"])
def test_a_module_of_the_same_name_is_reported_with_the_remedy(name: str, script: str, tmp_path: Path) -> None:
    other = tmp_path / name
    other.parent.mkdir(exist_ok=True)
    other.write_text("Robot = None\n")
    (tmp_path / "script.py").write_text(script)
    result = run(tmp_path, sys.executable, "script.py", PYTHONSAFEPATH="")
    assert result.returncode == 1
    last = result.stderr.strip().splitlines()[-1]
    assert last.startswith(f"ImportError: `import models` finds {other}, not the package that selfmotion installs")
    assert "Rename that file or folder" in last
    assert "python -P" in last
    assert "PYTHONSAFEPATH=1" in last


def test_a_folder_without_modules_is_named_if_it_is_all_that_is_found(tmp_path: Path) -> None:
    (tmp_path / "models").mkdir()
    (tmp_path / "installed").mkdir()
    (tmp_path / "installed" / "ocp").symlink_to(ROOT / "ocp")
    result = run(tmp_path, sys.executable, "-S", "-c", "import ocp", PYTHONPATH="installed", PYTHONSAFEPATH="")
    last = result.stderr.strip().splitlines()[-1]
    assert last.startswith(f"ImportError: `import models` finds {tmp_path / 'models'}, not the package that selfmotion")


def test_the_remedy_works_and_a_folder_without_modules_does_no_harm(tmp_path: Path) -> None:
    (tmp_path / "models.py").write_text("Robot = None\n")
    result = run(tmp_path, sys.executable, "-P", "-m", "ocp", "--version")
    assert (result.returncode, result.stdout.split()[0]) == (0, "selfmotion"), result.stderr
    (tmp_path / "models.py").unlink()
    (tmp_path / "models").mkdir()  # such as one that holds URDF files
    result = run(tmp_path, sys.executable, "-m", "ocp", "--version", PYTHONSAFEPATH="")
    assert result.returncode == 0, result.stderr


def test_release_is_published_by_a_trusted_workflow_on_tags_alone() -> None:
    assert WORKFLOW[True] == {"push": {"tags": ["v*"]}}  # YAML 1.1 reads the key `on` as true
    assert WORKFLOW["permissions"] == {"contents": "read"}
    build, publish = WORKFLOW["jobs"]["build"], WORKFLOW["jobs"]["publish"]
    assert "make build" in [step.get("run") for step in build["steps"]]
    assert "permissions" not in build  # what runs the project's code cannot publish
    assert publish["needs"] == "build"
    assert publish["environment"] == "pypi"
    assert publish["permissions"] == {"id-token": "write"}
    assert [step["uses"].partition("@")[0] for step in publish["steps"]] == [
        "actions/download-artifact",
        "pypa/gh-action-pypi-publish",
    ]
    assert "secrets" not in str(WORKFLOW)
    assert "password" not in str(WORKFLOW)


@pytest.mark.parametrize(
    ("address", "version", "changes", "complaint"),
    [
        ("https://github.test/selfmotion", "1.2.0", CHANGES, ""),
        (PLACEHOLDER, "1.2.0", CHANGES, "Replace the placeholder"),
        ("https://github.test/selfmotion", "1.1.0", CHANGES, "has another version"),
        ("https://github.test/selfmotion", "1.2.0", CHANGES.replace("2030-01-31", "unreleased"), "has no section"),
        ("https://github.test/selfmotion", "1.2.0", CHANGES.replace(".", "x"), "has no section"),
    ],
)
def test_workflow_refuses_what_is_not_ready(
    address: str, version: str, changes: str, complaint: str, tmp_path: Path
) -> None:
    (tmp_path / "ocp").mkdir()
    (tmp_path / "ocp/__init__.py").write_text(f'__version__ = "{version}"\n')
    (tmp_path / "pyproject.toml").write_text(f'[project.urls]\nRepository = "{address}"\n')
    (tmp_path / "CHANGELOG.md").write_text(changes)
    script = next(step["run"] for step in WORKFLOW["jobs"]["build"]["steps"] if "tag" in step.get("name", ""))
    result = run(tmp_path, "bash", "-e", "-c", script, GITHUB_REF_NAME="v1.2.0")
    assert result.returncode == bool(complaint), result.stdout + result.stderr
    assert complaint in result.stdout


def test_workflow_finds_the_placeholder_and_the_version_where_they_are() -> None:
    placeholders = [line for line in (ROOT / "pyproject.toml").read_text(encoding="utf-8").splitlines() if HOST in line]
    assert placeholders in ([], [f'Repository = "{PLACEHOLDER}"'])
    lines = (ROOT / "ocp/__init__.py").read_text(encoding="utf-8").splitlines()
    assert lines.count(f'__version__ = "{ocp.__version__}"') == 1


def test_conda_recipe_has_the_requirements_of_the_project() -> None:
    recipe: Any = yaml.safe_load((ROOT / ".github/conda/recipe.yaml").read_text(encoding="utf-8"))
    oldest: Any = yaml.safe_load((ROOT / ".github/conda/variants.yaml").read_text(encoding="utf-8"))["python_min"]
    assert [f">={version}" for version in oldest] == [PROJECT["project"]["requires-python"]]
    required = [re.fullmatch(r"([\w-]+)(>=.+)", one) for one in PROJECT["project"]["dependencies"]]
    expected = [f"{CONDA_NAMES.get(match[1], match[1])} {match[2]}" for match in required if match]
    assert recipe["requirements"]["run"] == ["python >=${{ python_min }}", *expected]
    assert len(expected) == len(required)
    assert recipe["requirements"]["host"][1].replace(" ", "") in PROJECT["build-system"]["requires"]
    assert recipe["about"]["summary"] == PROJECT["project"]["description"]
    assert recipe["about"]["license"] == PROJECT["project"]["license"]
    scripts = PROJECT["project"]["scripts"].items()
    assert recipe["build"]["python"]["entry_points"] == [f"{name} = {target}" for name, target in scripts]


def test_container_runs_the_commands_of_the_readme() -> None:
    text = (ROOT / ".github/Dockerfile").read_text(encoding="utf-8")
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    assert {"reproduce", "test"} <= set(re.findall(r"make (\w+)$", text, re.MULTILINE)) <= targets
    version = re.search(r"^FROM python:(\d\.\d+)-", text, re.MULTILINE)
    assert version
    assert f"Programming Language :: Python :: {version[1]}" in PROJECT["project"]["classifiers"]


def test_source_distribution_contains_every_folder_and_page() -> None:
    parts = PROJECT["tool"]["hatch"]["build"]["targets"]["sdist"]["include"]
    assert all((ROOT / part.lstrip("/")).exists() for part in parts)
    automatic = {"README.md", "LICENSE", "PKG-INFO", "pyproject.toml"}
    pages = {file.name for file in ROOT.glob("*.md")} | {"CITATION.cff", "Makefile"}
    assert pages - automatic <= {part.lstrip("/") for part in parts}
    assert {f"/{name}" for name in ("docs", "models", "ocp", "results", "scripts", "tests")} <= set(parts)


def test_importing_the_packages_loads_no_part_of_scipy_and_no_matplotlib() -> None:
    heavy = ("scipy.interpolate", "scipy.optimize", "scipy.special", "scipy.stats", "matplotlib")
    code = f"import sys, models, ocp, ocp.__main__; print([name for name in {heavy!r} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
