"""Models are trained on rendered clips where av and hdf5plugin are not installed."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

TESTS = Path(__file__).parents[2]
BLOCK = """
import sys
class Absent:
    def find_spec(self, name, *rest):
        if name.partition('.')[0] in ('av', 'hdf5plugin', 'h5py'):
            raise ModuleNotFoundError(f'No module named {name!r}', name=name)
sys.meta_path.insert(0, Absent())
"""
SOURCES = """
from physion.training.sources import background, open_source, rendered
assert not {'av', 'hdf5plugin', 'h5py', 'torch'} & set(sys.modules)
"""
IMPORTS = """
import importlib, pkgutil
import physion.models, physion.training
files = {'physion.clips.movies', 'physion.clips.states'}
names = [
    module.name
    for package in (physion.models, physion.training)
    for module in pkgutil.walk_packages(package.__path__, package.__name__ + '.')
]
assert files < set(names) and len(names) > 15
for name in sorted(set(names) - files):
    importlib.import_module(name)
assert not {'av', 'hdf5plugin', 'h5py', 'physion.trials.trial_file'} & set(sys.modules)
for name in files:
    try:
        importlib.import_module(name)
    except ModuleNotFoundError:
        continue
    raise AssertionError(f'{name} was imported: the block does not work')
"""
TRAINING = """
import numpy as np, torch
from physion.models import Motion, Provenance, Spec
from physion.models.interface import TrainingSettings
from physion.clips.movies import background
from physion.clips.rendered import RenderedSource
from physion.training.train import train_model
from support.rendered_scenes import body, scene_of, trajectory_of

class MeanColor(torch.nn.Module):
    spec = Spec(image_size=16, context=3, future=1, stride=2)
    diet, window = 'clips', 2
    settings = TrainingSettings(steps=3, batch=2, validate_every=3)

    def __init__(self):
        super().__init__()
        self.color = torch.nn.Parameter(torch.zeros(3))

    def provenance(self):
        return Provenance('mean-color', 'random')

    def digest(self):
        return '0' * 64

    def prepare(self, sample):
        pass

    def loss(self, batch):
        return {'loss': ((batch.rgb.float() / 255 - self.color) ** 2).mean()}

motions = {}
for number in range(4):
    scene = scene_of(body('agent'), body('patient', at=(0.5, 0.4, 0.0)))
    path = np.zeros((50, 2, 3))
    path[:, 0, 0] = np.linspace(0.1 * number, 1.0, 50)
    path[:, 1] = (0.5, 0.4, 0.0)
    motions[f'trial_{number}'] = Motion(scene, trajectory_of(path))
source = RenderedSource(motions, MeanColor.spec, observed=False)
batches = background([[name] for name in motions], source.whole, ahead=2)
assert [batch.rgb.shape for batch in batches] == [(1, 4, 16, 16, 3)] * 4
model = MeanColor()
report = train_model(
    model, source, tuple(motions), seed=0, name='all', folder=None, accelerator='cpu'
)
assert report.steps == 3 and model.color.abs().sum() > 0
assert not {'av', 'hdf5plugin', 'h5py'} & set(sys.modules)
"""


@pytest.mark.parametrize(
    "program",
    [
        pytest.param(SOURCES, id="sources"),
        pytest.param(IMPORTS, id="imports", marks=pytest.mark.slow),
        pytest.param(TRAINING, id="training", marks=pytest.mark.slow),
    ],
)
def test_without_av_and_hdf5plugin(program: str, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", BLOCK + f"sys.path.insert(0, {str(TESTS)!r})\n" + program],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
