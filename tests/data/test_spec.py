"""The [data] table finds and reads its recordings."""

from __future__ import annotations

import numpy as np
import pytest

from rfdropo_bayes.data import DATA_VARIABLE, DataSpec, load_recordings
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.files import find_files


@pytest.fixture
def folder(sofa_table, asl_tables, build, write, tmp_path, monkeypatch):
    monkeypatch.delenv(DATA_VARIABLE, raising=False)
    (tmp_path / "sofa").mkdir()
    for number in (2, 1):
        write(sofa_table(4 + number), tmp_path / "sofa" / f"reach_{number}.csv")
    observations, commands = asl_tables()
    write(observations, tmp_path / "observations.csv.gz")
    write(commands, tmp_path / "commands.csv.gz")
    build().save(tmp_path / "ours.nc")
    return tmp_path


def test_globs_are_sorted_and_relative_to_the_experiment(folder):
    spec = DataSpec.parse({"format": "sofa-csv", "fit": ["sofa/reach_*.csv"]})
    assert [recording.name for recording in load_recordings(spec, folder)] == ["reach_1", "reach_2"]
    assert load_recordings(spec, folder, role="test") == []


def test_the_variable_says_where_the_data_are(folder, tmp_path_factory, monkeypatch):
    spec = DataSpec.parse({"format": "netcdf", "fit": ["ours.nc"]})
    elsewhere = tmp_path_factory.mktemp("experiment")
    with pytest.raises(InputError, match=f"ours.nc: no such file; looked in .* \\({DATA_VARIABLE} is not set\\)"):
        load_recordings(spec, elsewhere)
    monkeypatch.setenv(DATA_VARIABLE, str(folder))
    assert load_recordings(spec, elsewhere)[0].name == "made"
    monkeypatch.setenv(DATA_VARIABLE, str(elsewhere))
    with pytest.raises(InputError, match=f"\\({DATA_VARIABLE} is set\\).*set {DATA_VARIABLE} to the folder"):
        load_recordings(DataSpec.parse({"format": "netcdf", "fit": ["theirs*.nc"]}), folder)


def test_what_the_variable_does_not_have_is_looked_for_beside_the_experiment(folder, tmp_path_factory, monkeypatch):
    """The bundled example lies beside its experiment file, wherever the variable points."""
    monkeypatch.setenv(DATA_VARIABLE, str(tmp_path_factory.mktemp("data")))
    spec = DataSpec.parse({"format": "netcdf", "fit": ["ours.nc"]})
    assert load_recordings(spec, folder)[0].name == "made"


def test_an_entry_may_be_a_table_with_rows(folder):
    entry = {"observations": "observations.csv.gz", "commands": "commands.csv.gz"}
    spec = DataSpec.parse(
        {
            "format": "asl-csv",
            "fit": [entry | {"rows": [0, 20]}],
            "test": [entry | {"rows": [21, 59]}],
            "resample": 0.02,
        }
    )
    fit, test = (load_recordings(spec, folder, role=role)[0] for role in ("fit", "test"))
    assert fit.name == "observations[0:20]"
    np.testing.assert_allclose(fit.time, 0.02 * np.arange(11), atol=1e-12)
    np.testing.assert_allclose(test.time, 0.02 * np.arange(20), atol=1e-12)
    with pytest.raises(InputError, match=r"rows \[0, 60\] are out of range"):
        load_recordings(DataSpec.parse({"format": "asl-csv", "fit": [entry | {"rows": [0, 60]}]}), folder)
    zero = DataSpec.parse({"format": "asl-csv", "fit": [entry | {"commands": "none"}]})
    assert not load_recordings(zero, folder)[0].command.any()


def test_a_test_recording_must_not_have_been_fitted(folder):
    with pytest.raises(InputError, match="shares rows with a recording that is fitted"):
        load_recordings(DataSpec.parse({"format": "netcdf", "fit": ["ours.nc"], "test": ["*.nc"]}), folder, role="test")
    parts = {
        "format": "netcdf",
        "fit": [{"observations": "ours.nc", "rows": [0, 5]}],
        "test": [{"observations": "ours.nc", "rows": [5, 9]}],
    }
    with pytest.raises(InputError, match="shares rows"):
        load_recordings(DataSpec.parse(parts), folder)


def test_names_are_distinct(folder, sofa_table, write):
    (folder / "again").mkdir()
    write(sofa_table(7), folder / "again" / "reach_1.csv")
    spec = DataSpec.parse({"format": "sofa-csv", "fit": ["sofa/reach_1.csv", "again/reach_1.csv"]})
    assert [recording.name for recording in load_recordings(spec, folder)] == ["sofa/reach_1", "again/reach_1"]
    twice = DataSpec.parse({"format": "sofa-csv", "fit": ["sofa/reach_1.csv", "sofa/*_1.csv"]})
    with pytest.raises(InputError, match="listed twice"):
        load_recordings(twice, folder)
    for day in ("monday", "tuesday"):
        (folder / day / "run").mkdir(parents=True)
        write(sofa_table(5), folder / day / "run" / "reach_9.csv")
    days = DataSpec.parse({"format": "sofa-csv", "fit": ["*day/run/reach_9.csv", "sofa/reach_1.csv"]})
    told = ["monday/run/reach_9", "tuesday/run/reach_9", "reach_1"]
    assert [recording.name for recording in load_recordings(days, folder)] == told


def test_commands_of_several_recordings_are_never_those_of_the_first(folder, asl_tables, write):
    """A pattern of commands says nothing of which recording each file belongs to."""
    observations, commands = asl_tables()
    for number in (1, 2):
        write(observations, folder / f"seen_{number}.csv.gz")
        write(commands, folder / f"sent_{number}.csv.gz")
    spec = DataSpec.parse({"format": "asl-csv", "fit": [{"observations": "seen_*.gz", "commands": "sent_*.gz"}]})
    with pytest.raises(InputError, match=r"sent_\*\.gz: matches 2 files \(sent_1.csv.gz, sent_2.csv.gz\)"):
        load_recordings(spec, folder)
    one = DataSpec.parse({"format": "asl-csv", "fit": [{"observations": "seen_*.gz", "commands": "sent_2*"}]})
    assert len(load_recordings(one, folder)) == 2


def test_commands_of_their_own_only_where_the_format_has_them(folder):
    entry = {"observations": "sofa/reach_1.csv", "commands": "commands.csv.gz"}
    with pytest.raises(InputError, match="keeps the commands in the same file"):
        load_recordings(DataSpec.parse({"format": "sofa-csv", "fit": [entry]}), folder)


def test_asl_observations_without_commands_ask_for_them(folder):
    spec = DataSpec.parse({"format": "asl-csv", "fit": ["observations.csv.gz"]})
    with pytest.raises(InputError, match=r"--commands FILE; commands = 'none'"):
        load_recordings(spec, folder)


def test_the_real_tables_of_the_experiments_load(datasets, monkeypatch):
    monkeypatch.setenv(DATA_VARIABLE, str(datasets))
    spec = DataSpec.parse(
        {
            "format": "optitrack-csv",
            "fit": ["sim2real_trunk/AKLWI_*.csv", "sim2real_trunk/X0HBR_*.csv"],
            "test": ["sim2real_trunk/AKLWI2_*.csv"],
        }
    )
    assert [len(load_recordings(spec, datasets, role=role)) for role in ("fit", "test")] == [8, 3]


@pytest.mark.parametrize("absolute", [False, True])
def test_a_name_that_exists_is_no_pattern(folder, absolute):
    """Signs of patterns in names of files, and of folders that patterns begin with."""
    lab = folder / "[lab] data"
    lab.mkdir()
    for name in ("run [1].csv", "run [2].csv", "run 1.csv", "what?.csv"):
        (lab / name).write_text("rows")
    below = str(lab) if absolute else "[lab] data"

    def found(name: str) -> list[str]:
        return [path.name for path in find_files(f"{below}/{name}", folder)]

    assert found("run [1].csv") == ["run [1].csv"]
    assert found("what?.csv") == ["what?.csv"]
    assert found("run*.csv") == ["run 1.csv", "run [1].csv", "run [2].csv"]
    assert found("run [12].csv") == ["run 1.csv"]
    with pytest.raises(InputError, match="no such file"):
        found("run [5].csv")


def test_a_name_that_exists_comes_before_a_pattern_that_matches_elsewhere(folder, tmp_path_factory, monkeypatch):
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    (elsewhere / "run 1.csv").write_text("other")
    (folder / "run [1].csv").write_text("own")
    monkeypatch.setenv(DATA_VARIABLE, str(elsewhere))
    assert find_files("run [1].csv", folder) == [folder / "run [1].csv"]


def test_commands_measured_with_the_pose_are_in_force_in_their_own_row(tmp_path):
    """By default the row before shows; with the key the row's own, whatever comes before or after."""
    (tmp_path / "run.csv").write_text("t,c,x,y,z\n0,1,0,0,1\n1,2,0,0,1\n3,4,0,0,1\n")
    columns = {
        "time": "t", "commands": ["c"], "command_unit": "mm", "positions": [["x", "y", "z"]], "position_unit": "m",
    }  # fmt: skip
    table = {"format": "csv", "fit": ["run.csv"], "columns": {**columns, "commands_with_poses": True}}
    (run,) = load_recordings(DataSpec.parse(table), tmp_path)
    just_before = run.command_at(run.time - 1e-3)[:, 0]
    assert just_before.tolist() == pytest.approx([1e-3, 2e-3, 4e-3])
    assert run.command_time.tolist() == [0.5, 2.0]
    table["columns"] |= {"command_time": "t"}
    with pytest.raises(InputError, match="contradict each other"):
        DataSpec.parse(table)
