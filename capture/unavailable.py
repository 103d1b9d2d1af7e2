"""The error that every camera raises when it cannot be used."""


class CameraUnavailable(RuntimeError):
    """No camera, or no longer: what was expected, what was found, what to do."""

    exit_code = 69
