"""Files with weights: what is taken, and what is said about those that are not."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from vggt_tiny import META, state, write_checkpoint

from aim_slam_ros.models.vggt.checkpoint import CheckpointError
from aim_slam_ros.models.vggt.loading import load_vggt
from aim_slam_ros.models.vggt.network import Vggt
from aim_slam_ros.models.vggt.synthetic import TINY, random_network


def _same(a: Vggt, b: Vggt) -> bool:
    return all(torch.equal(x, y) for x, y in zip(a.state_dict().values(),
                                                 b.state_dict().values(), strict=True))


class TestTaken:
    def test_a_folder_or_a_file(self, tmp_path: Path) -> None:
        path = write_checkpoint(tmp_path)
        assert _same(load_vggt(path), random_network(TINY))
        assert _same(load_vggt(tmp_path), random_network(TINY))

    @pytest.mark.parametrize('nested', [False, True])
    def test_a_pickled_state_dict(self, tmp_path: Path, nested: bool) -> None:
        """As torch.save writes it, alone or as training scripts nest it."""
        weights = state(random_network(TINY))
        torch.save({'model': weights, 'epoch': 3} if nested else weights, tmp_path / 'model.pt')
        assert _same(load_vggt(tmp_path / 'model.pt', config=TINY), random_network(TINY))

    @pytest.mark.parametrize('ending', ['safetensors', 'pt'])
    def test_the_other_heads_are_not_read(self, tmp_path: Path, ending: str) -> None:
        """Memory grows by less than the 128 MB that the file has for them."""
        weights = state(random_network(TINY))
        weights['track_head.corr.weight'] = torch.ones(32 << 20)
        path = tmp_path / f'model.{ending}'
        save_file(weights, path) if ending == 'safetensors' else torch.save(weights, path)
        del weights
        load_vggt(path, config=TINY)     # what the library itself needs is loaded now
        before = _resident_mb()
        network = load_vggt(path, config=TINY)
        assert _resident_mb() - before < 64
        assert _same(network, random_network(TINY))

    def test_weights_are_cast_as_they_are_read(self, tmp_path: Path) -> None:
        """The transformer's multiplications in bfloat16, the rest and the heads in float32."""
        network = load_vggt(write_checkpoint(tmp_path), dtype=torch.bfloat16)
        dtypes = {name: tensor.dtype for name, tensor in network.named_parameters()}
        assert dtypes['aggregator.global_blocks.3.mlp.fc1.weight'] == torch.bfloat16
        assert dtypes['aggregator.patch_embed.patch_embed.proj.bias'] == torch.bfloat16
        assert dtypes['aggregator.global_blocks.3.norm1.weight'] == torch.float32
        assert dtypes['aggregator.camera_token'] == torch.float32
        assert {dtype for name, dtype in dtypes.items() if '_head.' in name} == {torch.float32}

    def test_half_precision_files_run_in_float32(self, tmp_path: Path) -> None:
        weights = {name: tensor.half() for name, tensor in state(random_network(TINY)).items()}
        save_file(weights, tmp_path / 'model.safetensors')
        network = load_vggt(tmp_path, config=TINY)
        assert {p.dtype for p in network.parameters()} == {torch.float32}

    def test_nothing_is_trained(self, tmp_path: Path) -> None:
        network = load_vggt(write_checkpoint(tmp_path))
        assert not network.training and not any(p.requires_grad for p in network.parameters())


class TestRefused:
    """Each with its own reason and what to do."""

    def _reason(self, path: Path) -> str:
        with pytest.raises(CheckpointError) as refusal:
            load_vggt(path)
        return str(refusal.value)

    def test_no_file(self, tmp_path: Path) -> None:
        assert re.search('no weights at .*download_weights', self._reason(tmp_path / 'no.pt'))
        assert re.search('holds no .safetensors.*download_weights', self._reason(tmp_path))

    @pytest.mark.parametrize('content, what', [
        (b'', 'is empty'),
        (b'<!DOCTYPE html><html><head><title>Sign in</title>', 'HTML page'),
        (b'\n  <html lang="en">', 'HTML page'),
        (b'version https://git-lfs.github.com/spec/v1\noid sha256:00', 'Git LFS pointer'),
        (b'\x00\x01 nothing of the kind' * 9, 'neither a .safetensors nor a .pt'),
        (b'\x80\x02}q\x00.', 'neither a .safetensors nor a .pt'),
        ((40).to_bytes(8, 'little') + b'{"a": ' + b' ' * 50, 'no readable .safetensors header')])
    def test_another_kind_of_file(self, tmp_path: Path, content: bytes, what: str) -> None:
        path = tmp_path / 'model.safetensors'
        path.write_bytes(content)
        assert what in self._reason(path)

    @pytest.mark.parametrize('share', [0.001, 0.5, 0.999])
    def test_the_first_part_of_a_safetensors_file(self, tmp_path: Path, share: float) -> None:
        path = write_checkpoint(tmp_path)
        os.truncate(path, int(path.stat().st_size * share))
        assert 'incomplete download' in self._reason(path)

    @pytest.mark.parametrize('share', [0.1, 0.999])
    def test_the_first_part_of_a_pickled_file(self, tmp_path: Path, share: float) -> None:
        path = tmp_path / 'model.pt'
        torch.save(state(random_network(TINY)), path)
        os.truncate(path, int(path.stat().st_size * share))
        assert 'incomplete download' in self._reason(path)

    @pytest.mark.parametrize('names, what', [
        (('cls_token', 'blocks.0.norm1.weight'), 'DINOv2'),
        (('enc_blocks.0.norm1.weight', 'dec_blocks.0.norm1.weight'), 'MASt3R'),
        (('model.backbone.a', 'model.head.b'), 'Depth Anything 3'),
        (('aggregator.camera_token', 'camera_head.token_norm.weight'), 'without camera or depth'),
        (('conv1.weight', 'fc.bias'), 'something unknown, with conv1, fc'),
        ((), 'without any tensor')])
    def test_another_model(self, tmp_path: Path, names: tuple[str, ...], what: str) -> None:
        path = tmp_path / 'model.safetensors'
        save_file({name: torch.zeros(3) for name in names}, path)
        reason = self._reason(path)
        assert what in reason and 'tensors are missing' in reason

    def test_another_size_of_vggt(self, tmp_path: Path) -> None:
        path = write_checkpoint(tmp_path)
        (tmp_path / 'meta.json').unlink()
        reason = self._reason(path)
        assert 'aggregator.patch_embed.blocks.2' in reason and 'meta.json' in reason

    def test_misshapen_tensors(self, tmp_path: Path) -> None:
        """The first few are named with both shapes."""
        meta = {'kind': 'tiny', 'tiny': {**META['tiny'], 'features': 32}}
        path = write_checkpoint(tmp_path)
        (tmp_path / 'meta.json').write_text(json.dumps(meta), encoding='utf-8')
        reason = self._reason(path)
        assert 'another shape' in reason and '(16, 16, 3, 3) instead of (32, 16, 3, 3)' in reason
        assert reason.count('instead of') == 3 and '...' in reason

    @pytest.mark.parametrize('meta', ['{', '[]', '{"kind": "tiny", "tiny": {"embed_dim": 63}}',
                                      '{"kind": "tiny", "tiny": {"patch_size": 16}}',
                                      '{"kind": "tiny", "tiny": {"vit_dim": 32}}'])
    def test_sizes_that_make_no_sense(self, tmp_path: Path, meta: str) -> None:
        path = write_checkpoint(tmp_path)
        (tmp_path / 'meta.json').write_text(meta, encoding='utf-8')
        assert 'meta.json does not describe' in self._reason(path)

    def test_code_in_a_pickle_is_not_run(self, tmp_path: Path) -> None:
        torch.save({'weights': torch.zeros(2), 'hook': _Dangerous(tmp_path)}, tmp_path / 'm.pt')
        assert 'foreign code' in self._reason(tmp_path / 'm.pt')
        assert not (tmp_path / 'was_here').exists()

    def test_something_else_than_a_state_dict(self, tmp_path: Path) -> None:
        torch.save([torch.zeros(2)], tmp_path / 'm.pt')
        assert 'holds a list' in self._reason(tmp_path / 'm.pt')


class _Dangerous:
    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __reduce__(self) -> tuple[object, ...]:
        return os.mkdir, (str(self._folder / 'was_here'),)


def _resident_mb() -> float:
    pages = int(Path('/proc/self/statm').read_text(encoding='ascii').split()[1])
    return pages * os.sysconf('SC_PAGE_SIZE') / 1e6
