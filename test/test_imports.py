"""Walks the imports of every module and holds them to the rooms of CONTRIBUTING.md."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import Iterator

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ('aim_slam_ros', 'msg_adapters')
EVERYTHING = ('aim_slam_ros', 'msg_adapters')

# What a room may import, besides itself. A name covers what lies below it.
_BASE = ('types', 'config', 'devices', 'geometry')
_ROOMS = {
    '__init__': (),
    'types': (),
    'settings': (),
    'config': ('settings',),
    'devices': ('settings',),
    'geometry': ('types',),
    'registration': _BASE,
    'models': _BASE,
    'frontend': (*_BASE, 'registration', 'models.base'),
    'loop_closure': (*_BASE, 'registration', 'models.base'),
    'datasets': ('types', 'geometry'),
    'evaluation': ('types', 'geometry'),
}
ALLOWED = {f'aim_slam_ros.{room}': tuple(f'aim_slam_ros.{name}' for name in names)
           for room, names in _ROOMS.items()}
# What a message's pixels mean does not depend on ROS: bags are read without it.
ALLOWED['aim_slam_ros.datasets'] += ('msg_adapters.encodings', 'msg_adapters.errors')
ALLOWED |= {'msg_adapters': ('aim_slam_ros.types',)}
ALLOWED |= {f'aim_slam_ros.{room}': EVERYTHING
            for room in ('nodes', 'cli', 'ablation', 'offline', 'assessment',
                         'recorded_truth')}

# Who alone may import a third-party package.
ROS_MESSAGES = re.compile(r'\w+_(msgs|srvs|interfaces)')
CONFINED = (
    (re.compile(r'rclpy|tf2_\w+'), ('aim_slam_ros.nodes', 'aim_slam_ros.cli')),
    (ROS_MESSAGES, ('msg_adapters', 'aim_slam_ros.nodes')),
    (re.compile('gtsam'), ('aim_slam_ros.loop_closure.pose_graph',)),
)


def violations(root: Path) -> list[str]:
    """Every import below ``root`` that breaks a rule, one line each."""
    modules = {_module_name(path.relative_to(root)): path
               for package in PACKAGES for path in sorted((root / package).rglob('*.py'))}
    return [f'{path.relative_to(root)}: {complaint}' for name, path in modules.items()
            for complaint in _complaints(name, path, set(modules))]


def _module_name(path: Path) -> str:
    parts = path.with_suffix('').parts
    return '.'.join(parts[:-1] if parts[-1] == '__init__' else parts)


def _room(module: str) -> str:
    if module.startswith('msg_adapters'):
        return 'msg_adapters'
    first = module.split('.')[1:2] or ['__init__']
    return f'aim_slam_ros.{first[0]}'


def _complaints(module: str, path: Path, modules: set[str]) -> Iterator[str]:
    room = _room(module)
    if room not in ALLOWED:
        yield f'{room} is a room without a rule'
        return
    for target in _imports(module, path, modules):
        if target.split('.')[0] in PACKAGES:
            if not _below(target, (room, *ALLOWED[room])):
                yield f'{module} may not import {target}'
        for pattern, owners in CONFINED:
            if pattern.fullmatch(target.split('.')[0]) and not _below(module, owners):
                yield f'{module} may not import {target}'


def _below(module: str, names: tuple[str, ...]) -> bool:
    return any(module == name or module.startswith(f'{name}.') for name in names)


def _imports(module: str, path: Path, modules: set[str]) -> Iterator[str]:
    """Full names of what a file imports, wherever in the file it does so."""
    for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'), str(path))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            origin = _origin(node, module, is_package=path.name == '__init__.py')
            for alias in node.names:
                full = f'{origin}.{alias.name}'
                yield full if full in modules else origin
        elif isinstance(node, ast.Call):
            yield from _imported_by_name(node)


def _origin(node: ast.ImportFrom, module: str, is_package: bool) -> str:
    if not node.level:
        return node.module or ''
    parts = module.split('.')
    parents = parts[:len(parts) - node.level + (1 if is_package else 0)]
    return '.'.join([*parents, *([node.module] if node.module else [])])


def _imported_by_name(call: ast.Call) -> Iterator[str]:
    """``importlib.import_module('x')`` and ``__import__('x')``."""
    name = getattr(call.func, 'attr', getattr(call.func, 'id', ''))
    if name in ('import_module', '__import__') and call.args and \
            isinstance(call.args[0], ast.Constant):
        yield str(call.args[0].value)


def test_no_import_breaks_a_rule() -> None:
    assert violations(ROOT) == []


def test_the_tree_is_really_walked() -> None:
    """An empty list of violations must not come from an empty list of modules."""
    text = (ROOT / 'aim_slam_ros' / 'config.py').read_text(encoding='utf-8')
    assert 'class Config' in text
    modules = {_module_name(p.relative_to(ROOT)) for p in (ROOT / 'aim_slam_ros').rglob('*.py')}
    assert {'aim_slam_ros', 'aim_slam_ros.types', 'aim_slam_ros.geometry.sim3',
            'aim_slam_ros.offline'} <= modules
    path = ROOT / 'aim_slam_ros' / 'offline.py'
    assert 'aim_slam_ros.config' in _imports('aim_slam_ros.offline', path, modules)


@pytest.mark.parametrize('module, line', [
    ('types.py', 'from aim_slam_ros.config import Config'),
    ('config.py', 'from . import types'),
    ('geometry/lines.py', 'from ..config import Config'),
    ('registration/flow.py', 'from ..models.base import GeometryModel'),
    ('models/base.py', 'from ..frontend import pipeline'),
    ('frontend/pipeline.py', 'from ..loop_closure import pipeline'),
    ('frontend/pipeline.py', 'from ..models import make_model'),
    ('frontend/pipeline.py', 'import aim_slam_ros.models.classical'),
    ('loop_closure/pipeline.py', 'def f():\n    from aim_slam_ros.frontend import pipeline'),
    ('loop_closure/retrieval.py', 'import gtsam'),
    ('loop_closure/retrieval.py', 'import importlib\nimportlib.import_module("gtsam")'),
    ('datasets/tum.py', 'from ..config import Config'),
    ('datasets/tum.py', 'from sensor_msgs.msg import Image'),
    ('evaluation/report.py', 'from ..datasets import tum'),
    ('frontend/pipeline.py', 'import rclpy'),
    ('offline.py', 'import rclpy.node'),
    ('offline.py', 'from nav_msgs.msg import Path'),
    ('frontend/pipeline.py', 'import msg_adapters.images'),
    ('../msg_adapters/images.py', 'from aim_slam_ros.config import Config'),
    ('attic/old.py', 'import math'),
])
def test_a_violation_is_found(tmp_path: Path, module: str, line: str) -> None:
    _made_up_tree(tmp_path, module, line)
    assert len(violations(tmp_path)) == 1


@pytest.mark.parametrize('module, line', [
    ('models/base.py', 'from ..types import Frame'),
    ('frontend/pipeline.py', 'from ..models.base import GeometryModel\nfrom . import sigma'),
    ('frontend/pipeline.py', 'from ..models import base\nfrom ..registration import flow'),
    ('loop_closure/pose_graph.py', 'import gtsam'),
    ('nodes/frontend_node.py', 'import rclpy\nfrom sensor_msgs.msg import Image'),
    ('nodes/frontend_node.py', 'import msg_adapters.images\nfrom ..frontend import pipeline'),
    ('datasets/bags.py', 'from msg_adapters.encodings import rgb_from_image'),
    ('offline.py', 'from .frontend.pipeline import FrontendPipeline'),
    ('../msg_adapters/images.py', 'from sensor_msgs.msg import Image\nimport numpy'),
])
def test_what_is_allowed_passes(tmp_path: Path, module: str, line: str) -> None:
    _made_up_tree(tmp_path, module, line)
    assert violations(tmp_path) == []


def _made_up_tree(root: Path, module: str, line: str) -> None:
    """A package that obeys the rules, and one file with ``line``."""
    (root / 'aim_slam_ros').mkdir()
    (root / 'msg_adapters').mkdir()
    for name in ('models/base.py', 'models/__init__.py', 'registration/flow.py',
                 'frontend/sigma.py', 'types.py'):
        _write(root / 'aim_slam_ros' / name, 'import math')
    _write(root / 'aim_slam_ros' / module, line)


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text + '\n', encoding='utf-8')
