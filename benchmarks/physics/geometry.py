"""Size of the camera matrices and meshes in trial files.

    python benchmarks/physics/geometry.py

For the official scenes of the package: kilobytes (1024 bytes) that `physion.trials.trial_file` adds
to a trial file, mean and largest by scenario.
"""

from __future__ import annotations

import io
from collections import defaultdict

import h5py
import numpy as np

from physion.data.official import official
from physion.scenes.scene import Scene
from physion.trials.trial_file import GEOMETRY, geometry_arrays, storage


def file_size(scene: Scene, *, filled: bool) -> int:
    """Return the bytes of an HDF5 file with the geometry of a scene, or of an empty one."""
    buffer = io.BytesIO()
    with h5py.File(buffer, "w", libver=("v110", "v110")) as file:
        if filled:
            for path, array in geometry_arrays(scene, 256, 256).items():
                options = storage(array.shape, array.dtype, compatible=False, columns=True)
                dataset = file.create_dataset(path, data=array, **options)
                dataset.attrs["meaning"] = np.bytes_(GEOMETRY[path].meaning.encode())
    return len(buffer.getvalue())


def main() -> None:
    """Print the table."""
    sizes: dict[str, list[float]] = defaultdict(list)
    for trial in official().trials:
        scene = trial.scene
        added = file_size(scene, filled=True) - file_size(scene, filled=False)
        sizes[scene.scenario].append(added / 1024)
    rows = {
        **dict(sorted(sizes.items())),
        "all": [size for part in sizes.values() for size in part],
    }
    for name, values in rows.items():
        print(f"{name:10} {len(values):4} scenes, mean {np.mean(values):5.1f}, "
              f"largest {max(values):5.1f} KB")  # fmt: skip


if __name__ == "__main__":
    main()
