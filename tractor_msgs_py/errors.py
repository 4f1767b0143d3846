"""The errors a user can cause or meet; the CLI and the nodes show each in one line.

Not for programming mistakes: those stay ordinary exceptions with a traceback.
"""


class TractorEmsError(Exception):
    """Base of everything shown to a user in one line.

    Attributes:
        exit_code: process exit code; 2 for bad input, 3 for an aborted run.
    """

    exit_code = 2


class ConfigError(TractorEmsError):
    """A configuration value, file or parameter is wrong (names file, field, value, range)."""


class CycleError(TractorEmsError):
    """A duty cycle is missing, malformed or not the one that was promised."""


class BagError(TractorEmsError):
    """A bag is missing, truncated, foreign, empty or breaks the wire contract."""


class PolicyError(TractorEmsError):
    """A policy file cannot be read or does not fit the powertrain or the observation."""


class RunAborted(TractorEmsError):
    """A run ended before its last step; the message is the named reason."""

    exit_code = 3
