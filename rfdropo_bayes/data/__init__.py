"""Recordings: the Trajectory type, importers, validation, fault masking, repeats."""

from rfdropo_bayes.data.asl_csv import read_asl_csv
from rfdropo_bayes.data.commands_alone import commands_alone
from rfdropo_bayes.data.faults import Faults, find_faults
from rfdropo_bayes.data.first_command import common_beginning
from rfdropo_bayes.data.matching import check_channels, shared_markers
from rfdropo_bayes.data.named_columns import CsvColumns
from rfdropo_bayes.data.optitrack_csv import read_optitrack_csv
from rfdropo_bayes.data.recorded import GOAL_AXES, Measured, Origin, SentCommands
from rfdropo_bayes.data.repeats import command_openings, group_repeats, noise_floor, same_opening
from rfdropo_bayes.data.sofa_csv import read_sofa_csv
from rfdropo_bayes.data.spec import DataSpec, RecordingEntry, find_data_file, load_recordings
from rfdropo_bayes.data.trajectory import Trajectory
from rfdropo_bayes.data.unseen import first_row_only, load_unseen, one_at_a_time, start_is_known
from rfdropo_bayes.files import DATA_VARIABLE
