"""Errors that users of the package can cause and correct, one class for each kind of input or output.

Every message reads ``<name> must <contract>, got <what came>[ at <where>]. <What to do>.``
"""


class BeamError(Exception):
    """Base class of all errors that a caller can cause and correct; the message can be shown to users as it is."""


class InvalidArrayError(BeamError, ValueError):
    """An array argument breaks its contract of shape, type, range or finiteness."""


class InvalidOptionError(BeamError, ValueError):
    """A scalar argument, an option or a combination of options is outside its contract."""


class AssetFormatError(BeamError, ValueError):
    """A file breaks its format: it is truncated, or has wrong types or values out of range."""


class SchemaVersionError(AssetFormatError):
    """An asset was written in a schema version that this package does not read."""


class DeviceError(BeamError, RuntimeError):
    """A requested compute device does not exist."""


class MissingPackageError(BeamError, ImportError):
    """A module was imported whose optional package is not installed; the message names the extra."""


class MissingFileError(BeamError, FileNotFoundError):
    """An input file or folder does not exist or cannot be read."""


class OutputError(BeamError, OSError):
    """An output could not be written; no partial output is left behind."""


class UnfinishedError(BeamError, RuntimeError):
    """Steps of a long job failed for good; all that do not need them are done and kept."""
