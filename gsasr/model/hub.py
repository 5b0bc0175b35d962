"""The authors' weights by name, downloaded once into the usual cache of `huggingface_hub`."""

from __future__ import annotations

from pathlib import Path

from ..errors import CheckpointError

REPOSITORY = "mutou0308/GSASR"
FILES = ("encoder.pth", "decoder.pth")

FOLDERS = {  # the spelling is the repository's
    "edsr-div2k": "GSASR_enhenced_ultra/EDSR_DIV2K",
    "edsr-df2k": "GSASR_enhenced_ultra/EDSR_DF2K",
    "rdn-div2k": "GSASR_enhenced_ultra/RDN_DIV2K",
    "rdn-df2k": "GSASR_enhenced_ultra/RDN_DF2K",
    "swinir-div2k": "GSASR_enhenced_ultra/SWIN_DIV2K",
    "swinir-df2k": "GSASR_enhenced_ultra/SWIN_DF2K",
    "hatl-sa1b": "GSASR_enhenced_ultra/HATL_SA1B",
    "edsr-paper": "GSASR_paper/EDSR",
    "rdn-paper": "GSASR_paper/RDN",
    "swinir-paper": "GSASR_paper/SWIN",
}
"""Preset -> folder in the repository that holds FILES."""

PATIENCE = 10.0  # seconds to wait for the first answer


def fetch(name: str, anew: bool = False) -> tuple[Path, Path]:
    """The encoder's and the decoder's file of a preset in FOLDERS.

    What the cache has is taken from there, without the network; the rest is downloaded, with a bar
    of progress on a terminal. anew: download even what the cache has.

    Raises CheckpointError, which names the files to download by hand.
    """
    encoder, decoder = (_file(name, f"{FOLDERS[name]}/{file}", anew) for file in FILES)
    return encoder, decoder


def _file(name: str, file: str, anew: bool) -> Path:
    import huggingface_hub as hub

    if not anew:
        try:
            return Path(hub.hf_hub_download(REPOSITORY, file, local_files_only=True))
        except (OSError, ValueError):  # not there, or half
            pass
    try:
        # The download itself tries for half a minute before it gives up on a missing network.
        hub.get_hf_file_metadata(hub.hf_hub_url(REPOSITORY, file), timeout=PATIENCE)
        return Path(hub.hf_hub_download(REPOSITORY, file, force_download=anew))
    except Exception as error:  # of the hub, of HTTP, of the system: their kinds vary by version
        raise CheckpointError(
            f"Cannot download {file} of {name} ({_reason(error)}); fetch {' and '.join(FILES)} "
            f"by hand from https://huggingface.co/{REPOSITORY}/tree/main/{FOLDERS[name]} "
            "into one folder and pass --model FOLDER."
        ) from error


def _reason(error: Exception) -> str:
    from huggingface_hub import errors

    if isinstance(error, errors.OfflineModeIsEnabled):
        return "HF_HUB_OFFLINE is set"
    if isinstance(error, errors.GatedRepoError | errors.RepositoryNotFoundError):
        return "the repository gives no access"
    if isinstance(error, errors.RemoteEntryNotFoundError):
        return "the repository has no such file"
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return "no answer from the network"
