"""Cohorts of masks: reading, inspection and splits by person."""

from training.cohorts.assemble import CohortOptions
from training.cohorts.catalogue import CohortName, data_folder, load_cohort
from training.cohorts.cohort import Case, Cohort, Provenance, Refusal, Split
from training.cohorts.folder import read_folder

__all__ = [
    "Case",
    "Cohort",
    "CohortName",
    "CohortOptions",
    "Provenance",
    "Refusal",
    "Split",
    "data_folder",
    "load_cohort",
    "read_folder",
]
