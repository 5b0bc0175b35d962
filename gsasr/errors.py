"""The errors a user can cause; each message is one sentence that says what to do."""


class GsasrError(Exception):
    """Base of every expected error. The commands print it and exit with code 2."""


class RequestError(GsasrError, ValueError):
    """What was asked for makes no sense: a scale, a size, a region, an option."""


class ImageError(GsasrError):
    """A picture that cannot be read or written."""


class FieldError(GsasrError):
    """A file of Gaussians that cannot be read or written, or Gaussians that are malformed."""


class CheckpointError(GsasrError):
    """A model file that cannot be read, or that does not describe a known network."""


class BackendError(GsasrError):
    """A rasterizer that this machine cannot run (no OpenGL 4.3, no CUDA, out of memory)."""


class DataError(GsasrError):
    """Training or test data that cannot be used."""


class Cancelled(GsasrError):
    """The user stopped the work; nothing was written."""
