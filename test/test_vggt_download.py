"""download_weights: what it says before, without internet, and after; against a local server."""

from __future__ import annotations

import hashlib
import http.server
import importlib.util
import json
import os
import subprocess
import sys
import threading
from pathlib import Path
from typing import Iterator

import pytest
from vggt_tiny import META, write_checkpoint

from aim_slam_ros.cli import download_weights

needs_hub = pytest.mark.skipif(importlib.util.find_spec('huggingface_hub') is None,
                               reason='huggingface_hub, an optional extra, is not installed')
NOBODY = 'http://127.0.0.1:9'       # the discard port: nothing listens there


class _Hub(http.server.BaseHTTPRequestHandler):
    """Hugging Face's two answers: what a repository has, and a file (or the rest of it)."""

    protocol_version = 'HTTP/1.1'
    content = b''

    def do_HEAD(self) -> None:
        self._answer(with_body=False)

    def do_GET(self) -> None:
        self._answer(with_body=True)

    def log_message(self, format: str, *args: object) -> None:
        """Quiet."""

    def _answer(self, with_body: bool) -> None:
        if self.path.startswith('/api/models/facebook/VGGT-1B?'):
            self._send(200, json.dumps(_repository(len(self.content))).encode(), {}, with_body)
        elif self.path.startswith('/facebook/VGGT-1B/resolve/'):
            start = int(self.headers.get('Range', 'bytes=0-').split('=')[1].split('-')[0])
            headers = {'ETag': f'"{hashlib.sha256(self.content).hexdigest()}"',
                       'X-Repo-Commit': 'a' * 40}
            self._send(206 if start else 200, self.content[start:], headers, with_body)
        elif self.path.startswith('/api/models/'):
            self._send(404, b'', {'X-Error-Code': 'RepoNotFound'}, with_body)
        else:
            self._send(404, b'', {}, with_body)

    def _send(self, status: int, body: bytes, headers: dict[str, str], with_body: bool) -> None:
        self.send_response(status)
        for name, value in (headers | {'Content-Length': str(len(body))}).items():
            self.send_header(name, value)
        self.end_headers()
        if with_body:
            self.wfile.write(body)


def _repository(size: int) -> dict[str, object]:
    return {'id': 'facebook/VGGT-1B', 'sha': 'a' * 40, 'private': False, 'downloads': 0,
            'likes': 0, 'tags': [], 'cardData': {'license': 'cc-by-nc-4.0'},
            'siblings': [{'rfilename': 'README.md', 'size': 3},
                         {'rfilename': 'model.safetensors', 'size': size}]}


@pytest.fixture
def hub(tmp_path: Path) -> Iterator[str]:
    """Its address. It offers the tiny checkpoint."""
    content = write_checkpoint(tmp_path / 'offered').read_bytes()
    handler = type('Handler', (_Hub,), {'content': content})
    server = http.server.ThreadingHTTPServer(('127.0.0.1', 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f'http://127.0.0.1:{server.server_port}'
    server.shutdown()
    server.server_close()


def _call(endpoint: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """In a process of its own: the library reads the endpoint when it is imported."""
    environment = {**os.environ, 'HF_ENDPOINT': endpoint, 'HF_HUB_DISABLE_TELEMETRY': '1',
                   'NO_PROXY': '127.0.0.1'}
    return subprocess.run([sys.executable, '-m', 'aim_slam_ros.cli.download_weights', *arguments],
                          env=environment, stdin=subprocess.DEVNULL, capture_output=True,
                          text=True, timeout=120)


def _one_line(error: str) -> bool:
    return error.startswith('download_weights: error: ') and error.count('\n') == 1


def test_without_the_library(capsys: pytest.CaptureFixture[str],
                             monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, 'huggingface_hub', None)
    assert download_weights.main([]) == 2
    error = capsys.readouterr().err
    assert _one_line(error) and 'pip install huggingface_hub' in error


@needs_hub
class TestDownload:
    def test_without_internet(self, tmp_path: Path) -> None:
        run = _call(NOBODY, '--out', str(tmp_path), '--yes')
        assert run.returncode == 2 and _one_line(run.stderr), run.stderr
        assert 'cannot be reached' in run.stderr

    def test_size_and_licence_come_first(self, hub: str, tmp_path: Path) -> None:
        """Nobody can be asked: nothing is downloaded."""
        run = _call(hub, '--out', str(tmp_path / 'w'))
        assert run.returncode == 2 and 'give --yes' in run.stderr, run.stderr
        assert 'cc-by-nc-4.0' in run.stdout and 'GB' in run.stdout
        assert not list((tmp_path / 'w').rglob('*.safetensors'))

    def test_the_file_arrives_and_is_looked_at(self, hub: str, tmp_path: Path) -> None:
        (tmp_path / 'meta.json').write_text(json.dumps(META), encoding='utf-8')
        run = _call(hub, '--out', str(tmp_path), '--yes')
        assert run.returncode == 0, run.stderr
        assert f'model.weights:={tmp_path / "model.safetensors"}' in run.stdout
        offered = tmp_path / 'offered' / 'weights.safetensors'
        assert (tmp_path / 'model.safetensors').read_bytes() == offered.read_bytes()

    def test_another_model_is_not_called_complete(self, hub: str, tmp_path: Path) -> None:
        run = _call(hub, '--out', str(tmp_path), '--yes')    # tiny weights, full sizes
        assert run.returncode == 2 and 'tensors are missing' in run.stderr

    def test_no_such_repository(self, hub: str, tmp_path: Path) -> None:
        run = _call(hub, '--out', str(tmp_path), '--repo', 'nobody/nothing')
        assert run.returncode == 2 and 'no such repository' in run.stderr, run.stderr
        run = _call(hub, '--out', str(tmp_path), '--repo', 'a/b/c')
        assert run.returncode == 2 and '--repo a/b/c' in run.stderr
