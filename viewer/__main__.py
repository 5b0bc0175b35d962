"""gsasr-viewer: open a picture and zoom into it, or render the same view without a window."""

from __future__ import annotations

import sys

from gsasr.errors import GsasrError

from . import arguments


def main(argv: list[str] | None = None) -> int:
    """Run the command; 0, or 2 after one sentence on standard error."""
    try:
        options = arguments.parse(argv)
        if options.snapshot is not None:
            from . import snapshot

            snapshot.run(options)
        else:
            from . import app

            app.run(
                options.file,
                options.model,
                options.condition,
                options.size,
                gpu_memory=options.gpu_memory,
            )
    except GsasrError as error:
        print(f"gsasr-viewer: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
