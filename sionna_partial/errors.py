"""Errors and warnings of the package."""


def one_line(text: str) -> str:
    """Return a text on one line, without control characters of a terminal."""
    return "".join(
        each if each.isprintable() else " " if each == "\n" else each.encode("unicode_escape").decode() for each in text
    )


class SionnaPartialError(Exception):
    """Base of every error that this package raises on purpose; messages name the field, its value and the remedy.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> try:
    ...     sp.load_map("missing.yaml")
    ... except sp.SionnaPartialError as error:
    ...     print(type(error).__name__)
    MapError
    """

    def __init__(self, *arguments: object) -> None:
        super().__init__(*(one_line(each) if isinstance(each, str) else each for each in arguments))


class MapError(SionnaPartialError, ValueError):
    """A map file or array that cannot be read as a floor plan."""


class PositionError(SionnaPartialError, ValueError):
    """A transmitter or receiver at an impossible position."""


class SettingsError(SionnaPartialError, ValueError):
    """A setting outside its allowed range."""


class ArgumentError(SettingsError, TypeError):
    """A setting given as an argument of a function that takes it within its settings."""


class MemoryLimitError(SionnaPartialError, MemoryError):
    """A job that would exceed its memory limit; it was not begun."""


class SceneError(SionnaPartialError, ValueError):
    """A scene folder that is missing, damaged or unsafe to load."""


class PredictorError(SionnaPartialError, ValueError):
    """A predictor file that is missing, damaged or of another kind, or data that cannot train one."""


class MeasurementError(SionnaPartialError, ValueError):
    """Measurements that are missing, damaged, or too few to calibrate a material."""


class OutputError(SionnaPartialError, OSError):
    """An output that could not be written; no partial file is left."""


class PredictorWarning(UserWarning):
    """A predictor that is probably worse than a simpler one."""


class BackendError(SionnaPartialError, RuntimeError):
    """A native library (LLVM, Sionna RT) that is missing or does not work."""
