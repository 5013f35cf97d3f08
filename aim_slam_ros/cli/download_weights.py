"""Fetch the weights of VGGT from Hugging Face."""

from __future__ import annotations

import argparse
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Sequence

from aim_slam_ros.cli.arguments import Refusal, writable_folder

# huggingface_hub is an optional extra: it is imported in _hub, when the command line is good.

DEFAULT_REPO = 'facebook/VGGT-1B'
_INTERRUPTED = 130
_TIMEOUT_S = 20


@dataclass(frozen=True)
class Offer:
    """What a repository has: a file with weights, its size and its licence, as it states them."""

    repo: str
    file: str
    size: int
    licence: str

    @property
    def url(self) -> str:
        return f'https://huggingface.co/{self.repo}'


def main(argv: Sequence[str] | None = None) -> int:
    """Exit status: 0 done, 2 refused, 130 interrupted."""
    try:
        args = _parser().parse_args(argv)
        return _download(args.repo, args.out.expanduser(), args.yes)
    except SystemExit as stop:      # argparse has said why
        return int(stop.code or 0)
    except Refusal as refusal:
        print(f'download_weights: error: {refusal}', file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print('download_weights: interrupted, the file is not complete: call it again',
              file=sys.stderr)
        return _INTERRUPTED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='download_weights', description=__doc__, allow_abbrev=False,
        epilog=f'{DEFAULT_REPO} is for non-commercial use. facebook/VGGT-1B-Commercial allows '
               'commercial use; its licence is accepted on its page, then `hf auth login`.')
    parser.add_argument('--repo', metavar='OWNER/NAME', default=DEFAULT_REPO,
                        help=f'the Hugging Face repository (default {DEFAULT_REPO})')
    parser.add_argument('--out', metavar='DIR', type=Path, default=Path('weights'),
                        help='where the file goes (default weights)')
    parser.add_argument('--yes', action='store_true',
                        help='take size and licence as accepted, do not ask')
    return parser


def _download(repo: str, out: Path, yes: bool) -> int:
    hub = _hub()
    offer = _offer(hub, repo)
    print(f'{offer.url}\n  file     {offer.file}\n  size     {offer.size / 1e9:.2f} GB\n'
          f'  licence  {offer.licence}\n  goes to  {out}')
    _room(writable_folder(out), offer)
    if not (yes or _agreed()):
        print('nothing was downloaded')
        return 0
    path = _fetched(hub, offer, out)
    _check(path)
    print(f'Complete. To use it: model.name:=vggt model.weights:={path.resolve()}')
    return 0


def _hub() -> ModuleType:
    try:
        import huggingface_hub.errors
    except ImportError as error:
        raise Refusal('huggingface_hub is not installed: pip install huggingface_hub') from error
    return huggingface_hub


def _offer(hub: ModuleType, repo: str) -> Offer:
    """The repository's first .safetensors file, or else its first .pt."""
    errors = hub.errors
    try:
        info = hub.HfApi().model_info(repo, files_metadata=True, timeout=_TIMEOUT_S)
    except errors.HFValidationError as error:
        raise Refusal(f'--repo {repo}: {error}') from error
    except errors.RepositoryNotFoundError as error:
        raise Refusal(f'--repo {repo}: Hugging Face has no such repository') from error
    except (OSError, errors.HTTPError) as error:
        raise _unreachable(error) from error
    files = {file.rfilename: file.size or 0 for file in info.siblings or ()}
    for ending in ('.safetensors', '.pt'):
        for name in sorted(files):
            if name.endswith(ending):
                licence = getattr(info.card_data, 'license_name', None) \
                    or getattr(info.card_data, 'license', None) or 'not stated: see its page'
                return Offer(repo, name, files[name], str(licence))
    raise Refusal(f'--repo {repo}: it has neither a .safetensors nor a .pt file')


def _unreachable(error: Exception) -> Refusal:
    return Refusal(f'Hugging Face cannot be reached ({_line(error)}). Get model.safetensors of '
                   f'{DEFAULT_REPO} on a machine with internet and copy it here')


def _line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


def _room(out: Path, offer: Offer) -> None:
    """Raises Refusal where the disk cannot hold the file; one that is there already needs none."""
    free = shutil.disk_usage(out).free
    if not (out / offer.file).exists() and free < offer.size:
        raise Refusal(f'--out {out}: {free / 1e9:.1f} GB are free, {offer.size / 1e9:.1f} GB are '
                      'needed')


def _agreed() -> bool:
    if not sys.stdin.isatty():
        raise Refusal('nobody can be asked here: give --yes to accept size and licence')
    return input('Download it under this licence? [y/N] ').strip().lower() in ('y', 'yes')


def _fetched(hub: ModuleType, offer: Offer, out: Path) -> Path:
    """The file; the library shows the progress."""
    errors = hub.errors
    try:
        return Path(hub.hf_hub_download(offer.repo, offer.file, local_dir=out))
    except errors.GatedRepoError as error:
        raise Refusal(f'{offer.url} asks you to accept its licence there, then to log in with '
                      '`hf auth login`') from error
    except (OSError, errors.HTTPError) as error:
        raise Refusal(f'the download stopped ({_line(error)}); call this again') from error


def _check(path: Path) -> None:
    """Names and shapes, without reading the weights themselves."""
    from aim_slam_ros.models.vggt.checkpoint import CheckpointError, open_checkpoint
    from aim_slam_ros.models.vggt.loading import check_names, network_for
    try:
        check_names(path, open_checkpoint(path), network_for(path).state_dict())
    except CheckpointError as error:
        raise Refusal(str(error)) from error


if __name__ == '__main__':
    sys.exit(main())
