"""Fixtures shared by several test files."""

import pytest

from gsasr.errors import BackendError


@pytest.fixture(scope="session")
def gl_context():
    """One headless OpenGL context for all tests of the main thread, software or not."""
    from gsasr.rasterize import gl

    try:
        return gl.create_context()
    except BackendError as failure:
        pytest.skip(str(failure))
