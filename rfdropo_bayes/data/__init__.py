"""Recordings: the Trajectory type, importers, validation, fault masking, repeats, registration."""

from rfdropo_bayes.data.asl_csv import read_asl_csv, read_motor_step
from rfdropo_bayes.data.faults import Faults, find_faults
from rfdropo_bayes.data.first_command import common_beginning
from rfdropo_bayes.data.matching import check_channels, shared_markers
from rfdropo_bayes.data.optitrack_csv import read_optitrack_csv
from rfdropo_bayes.data.plain_csv import CsvColumns, read_plain_csv
from rfdropo_bayes.data.registration import Registration, clock_offset, register, shift_commands, to_base_frame
from rfdropo_bayes.data.repeats import PureError, group_repeats, noise_floor, pure_error
from rfdropo_bayes.data.sofa_csv import read_sofa_csv
from rfdropo_bayes.data.spec import DataSpec, RecordingEntry, find_data_file, load_recordings
from rfdropo_bayes.data.trajectory import Trajectory
from rfdropo_bayes.data.unseen import first_row_only, load_unseen, start_is_known
from rfdropo_bayes.files import DATA_VARIABLE

__all__ = [
    "DATA_VARIABLE",
    "CsvColumns",
    "DataSpec",
    "Faults",
    "PureError",
    "RecordingEntry",
    "Registration",
    "Trajectory",
    "check_channels",
    "clock_offset",
    "common_beginning",
    "find_data_file",
    "find_faults",
    "first_row_only",
    "group_repeats",
    "load_recordings",
    "load_unseen",
    "noise_floor",
    "pure_error",
    "read_asl_csv",
    "read_motor_step",
    "read_optitrack_csv",
    "read_plain_csv",
    "read_sofa_csv",
    "register",
    "shared_markers",
    "shift_commands",
    "start_is_known",
    "to_base_frame",
]
