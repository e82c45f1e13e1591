"""The version of nerfcli, in one place."""

__version__ = "0.1.0"
