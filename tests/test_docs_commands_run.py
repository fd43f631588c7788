"""What README and docs tell the reader to type works as it stands."""

import os
import re
import shutil
import subprocess
import sys
import tomllib

import pytest
from command_line_cases import DEMO, ROOT, environment
from contract import check_document, strict_json

PAGE = (ROOT / "docs" / "diagnose-a-recording.md").read_text(encoding="utf-8")
LEARNING = (ROOT / "docs" / "learn-a-hamiltonian.md").read_text(encoding="utf-8")
LIBRARY = (ROOT / "docs" / "marginal-likelihood.md").read_text(encoding="utf-8")
POSTERIORS = (ROOT / "docs" / "posteriors.md").read_text(encoding="utf-8")
README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(text, language):
    """Fenced blocks of one language."""
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)


@pytest.fixture
def checkout(tmp_path):
    """A folder that has of the checkout only what the pages name, and `symplearn` on the path."""
    shutil.copytree(DEMO, tmp_path / "symplearn" / "demo")
    programs = tmp_path / "programs"
    programs.mkdir()
    wrapper = programs / "symplearn"
    wrapper.write_text(f'#!/bin/sh\nexec "{sys.executable}" -c "from symplearn.cli import main; main()" "$@"\n')
    wrapper.chmod(0o755)
    return tmp_path, environment(PATH=f"{programs}{os.pathsep}{os.environ['PATH']}")


@pytest.mark.slow
def test_commands_of_the_page(checkout):
    """Every sh block of "Diagnose a recording" runs, in order, and the answers are what the page says they are."""
    folder, places = checkout
    commands = blocks(PAGE, "sh")
    assert len(commands) == PAGE.count("```sh")
    for command in commands:
        done = subprocess.run(command, shell=True, cwd=folder, env=places, capture_output=True, text=True, timeout=600)
        assert done.returncode == 0 and done.stdout, done.stderr
    first, again = (strict_json((folder / n / "diagnosis.json").read_text()) for n in ("diagnosis", "again"))
    for document in (first, again):
        check_document(document, ["angle_rad"], ["p_theta"], recordings=3)
    assert first["verdict"] == "mismatch" and again["verdict"] in ("consistent", "unexplained")


def printed(text, checkout):
    """What the only Python block of a page prints."""
    folder, places = checkout
    (snippet,) = blocks(text, "python")
    done = subprocess.run(
        [sys.executable, "-c", snippet], cwd=folder, env=places, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_snippet_of_the_readme(checkout):
    """The README's Python runs, prints the finding, and gives the simulation with the finding put back."""
    out = printed(README, checkout)
    assert "mismatch" in out and 'effect = "viscous_damping"' in out


@pytest.mark.slow
def test_python_of_the_page(checkout):
    """The page's Python, with `Options`, finds among the effects that it names what the demo left out."""
    assert printed(PAGE, checkout).startswith("mismatch ")


def test_page_shows_the_file_that_ships():
    """The simulation file on the page is the one inside the package."""
    (shown,) = blocks(PAGE, "toml")
    assert tomllib.loads(shown) == tomllib.loads((DEMO / "simulation.toml").read_text())


def test_names_on_the_pages_exist():
    """Options, effects and links that the pages name are there."""
    from symplearn._effects import EFFECTS

    source = (ROOT / "symplearn" / "cli.py").read_text()
    for option in set(re.findall(r"`--([a-z-]+)", PAGE)) - {"no-cache"}:
        assert option.replace("-", "_") in source, option
    assert all(f"`{name}`" in PAGE for name in EFFECTS)
    pages = [(page.read_text(encoding="utf-8"), page.parent) for page in (ROOT / "docs").glob("*.md")]
    for text, home in [*pages, (README, ROOT)]:
        for link in re.findall(r"\]\(([^)#]+)\)", text):
            assert (home / link).exists(), link


def test_pages_name_no_machine():
    """No absolute path of anybody's machine stands in README or docs."""
    assert not re.search(r"(?<![\w.~])/(?:home|work|root|Users|tmp)/", README + PAGE + LEARNING + LIBRARY + POSTERIORS)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("page", "said"),
    [
        (LIBRARY, ["converged", "FAILED at reading"]),
        (LEARNING, ["+0.5", "Converged.", "NOT bounded", "Trained"]),
        (POSTERIORS, ["Converged.", "Choose", "NOT bounded from below", "Scores of 53 readings", "none diverged"]),
    ],
)
def test_python_of_the_library_pages(page, said, checkout):
    """The Python of each page runs in order, and what it asserts of itself holds."""
    folder, places = checkout
    program = "\n".join(blocks(page, "python"))
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=folder, env=places, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stderr
    assert all(words in done.stdout for words in said)
