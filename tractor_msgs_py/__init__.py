"""The wire contract of the tractor stack: topics, dataclasses, codecs and observations.

Everything else imports from here, and nothing here imports from the simulator or the policies.
"""

__version__ = "0.1.0"
