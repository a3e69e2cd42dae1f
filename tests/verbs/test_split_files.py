"""A file that holds several recordings becomes several files, whose names tell their sessions."""

import numpy as np
import pandas as pd
import pytest

from rfdropo_bayes.verbs.column_names import guess_columns
from rfdropo_bayes.verbs.split_files import split_files


def table(sessions: list[str], trials: int) -> pd.DataFrame:
    """Forty rows of each trial of each session; the clock begins anew with each."""
    random, parts = np.random.default_rng(0), []
    for session in sessions:
        for _ in range(trials):
            part = pd.DataFrame({"session": session, "t": np.arange(40.0)})
            for name in ("motor1", "motor2", "tip_x", "tip_y", "tip_z"):
                part[name] = random.normal(size=40)
            parts.append(part)
    return pd.concat(parts, ignore_index=True)


@pytest.mark.parametrize(("sessions", "trials"), [(["wet", "dry"], 2), (["wet"], 3), (["wet", "dry", "wet"], 1)])
def test_a_file_is_split_where_its_clock_begins_anew_and_its_session_changes(tmp_path, sessions, trials):
    whole = table(sessions, trials)
    whole.to_csv(tmp_path / "all.csv", index=False)
    found = split_files(tmp_path / "arm", [tmp_path / "all.csv"], guess_columns(tmp_path / "all.csv"))
    read = [pd.read_csv(path, sep=";") for path in found]
    pd.testing.assert_frame_equal(pd.concat(read, ignore_index=True), whole)
    assert [words != "" for words in found.values()] == [True] + [False] * (len(read) - 1)
    told = [path.name.removeprefix("all_").split("_")[1] for path in found if len(set(sessions)) > 1]
    order = list(dict.fromkeys(sessions))
    assert told == [str(1 + order.index(part["session"].iloc[0])) for part in read if told]


@pytest.mark.parametrize("name", ["trial_id", "Trial", "episode_index", "run", "experiment_nr"])
def test_a_file_is_split_where_its_trial_changes_though_its_clock_goes_on(tmp_path, name):
    whole = table(["wet", "dry"], 2).rename(columns={"session": name})
    whole["t"] = np.arange(float(len(whole)))
    whole.to_csv(tmp_path / "all.csv", index=False)
    guess = guess_columns(tmp_path / "all.csv")
    found = split_files(tmp_path / "arm", [tmp_path / "all.csv"], guess)
    assert [path.name for path in found] == ["all_1.csv", "all_2.csv"]  # no session: trials are of one day
    assert next(iter(found.values())) == "all.csv holds 2 recordings, split before rows 80"
    whole[name] = np.arange(len(whole)) // 3  # too short for recordings
    whole.to_csv(tmp_path / "all.csv", index=False)
    assert list(split_files(tmp_path / "b", [tmp_path / "all.csv"], guess)) == [tmp_path / "all.csv"]


def test_a_file_of_one_recording_stays(tmp_path):
    table(["wet"], 1).to_csv(tmp_path / "one.csv", index=False)
    path = tmp_path / "one.csv"
    assert split_files(tmp_path / "arm", [path], guess_columns(path)) == {path: ""}
    assert not (tmp_path / "arm").exists()
