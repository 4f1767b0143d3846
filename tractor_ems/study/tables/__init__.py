"""Every table of the study, as functions of its results: paper / here / difference, then ours."""

from tractor_ems.study.results import StudyResults
from tractor_ems.study.tables.ours import claims_table, our_tables, slips_table
from tractor_ems.study.tables.paper import paper_tables
from tractor_ems.study.tables.table import Table, to_csv, to_json, to_markdown

__all__ = [
    "Table",
    "build_tables",
    "claims_table",
    "our_tables",
    "paper_tables",
    "slips_table",
    "to_csv",
    "to_json",
    "to_markdown",
]


def build_tables(results: StudyResults) -> tuple[Table, ...]:
    """All tables in the order of the report; names are unique."""
    return (*paper_tables(results), *our_tables(results))
