"""What can go wrong at an edge of the package, one class per kind of edge.

Every message reads ``<name> must <contract>, got <what came>[ at <where>]. <What to do>.``
"""


class BeamError(Exception):
    """Base of all errors that a caller can cause and mend; its message is fit to be shown as it is."""


class InvalidArrayError(BeamError, ValueError):
    """An array argument breaks its contract of shape, type, range or finiteness."""


class InvalidOptionError(BeamError, ValueError):
    """A scalar argument, an option or a combination of options is outside its contract."""


class AssetFormatError(BeamError, ValueError):
    """A file is not what its name or header says: truncated, wrong types, values outside their range."""


class SchemaVersionError(AssetFormatError):
    """An asset was written in a schema version that this package does not read."""


class DeviceError(BeamError, RuntimeError):
    """A compute device was asked for that is not there."""


class MissingPackageError(BeamError, ImportError):
    """A room was imported whose optional package is not installed; the message names the extra."""


class MissingFileError(BeamError, FileNotFoundError):
    """An input file or folder does not exist or cannot be read."""


class OutputError(BeamError, OSError):
    """An output could not be written; nothing half-written is left behind."""
