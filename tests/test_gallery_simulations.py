"""Pages and simulations that were written for the gallery are ones that symplearn reads, on the real files too."""

import pytest
from contract import FAMILY
from real_recordings import FOLDER, absent

from experiments._gallery_known import WAYS
from experiments._gallery_page_file import PAGES, read_page, simulation_text
from experiments._gallery_prepare import prepared
from symplearn._recording import read_recordings
from symplearn._simulation_file import parse_simulation

NAMES = sorted(path.name for path in PAGES.iterdir())


@pytest.mark.parametrize("name", NAMES)
def test_page_says_where_it_comes_from(name):
    """Every page has what is known, its source and what was given, and each of its facts is one that can be asked."""
    page = read_page(name, FOLDER)
    assert page.title and page.known and page.source and page.given
    assert len({case.name for case in page.cases}) == len(page.cases)
    for fact in (fact for case in page.cases for fact in case.known):
        assert sum(bool(getattr(fact, way)) for way in WAYS) == 1, fact.about
        effects = [*fact.effects, *fact.only, *([fact.coefficient] if fact.coefficient else [])]
        assert {effect.split("(")[0].split(".")[0] for effect in effects} <= set(FAMILY)
        assert {fact.family, fact.open} - {None} <= set(FAMILY.values())


@pytest.mark.parametrize("path", sorted(PAGES.rglob("*.toml")), ids=lambda path: f"{path.parent.name}/{path.name}")
def test_simulations_parse(path):
    """Every simulation file of the gallery is one."""
    if path.name != "page.toml":
        assert parse_simulation(path.read_text(encoding="utf-8"), path.name).title


@pytest.mark.recordings
@pytest.mark.parametrize("name", [name for name in NAMES if read_page(name, FOLDER).cases])
def test_simulations_fit_the_recordings(name, tmp_path):
    """Simulation and recordings of every case go together, and its facts name parameters and columns that are there."""
    if not (FOLDER / name).is_dir():
        absent(f"no real recordings in {FOLDER}; set SYMPLEARN_RECORDINGS to their folder")
    page = read_page(name, FOLDER)
    for case in page.cases:
        file = parse_simulation(simulation_text(name, case, FOLDER), case.simulation)
        files = prepared([FOLDER / name / one for one in case.recordings], case.prepare, tmp_path)
        recordings = read_recordings(file, files)
        assert 1 <= case.picture <= len(recordings)
        assert {fact.parameter for fact in case.known} - {None} <= set(file.parameters)
        assert {fact.column for fact in case.known} - {None} <= set(recordings[0].columns)
