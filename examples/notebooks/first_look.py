# %% [markdown]
# # A first look
#
# gsx trains 3D Gaussian Splatting and shows what happens when you zoom in. Here a small built-in scene is trained for
# a minute; every line works the same with `scene=photos scene.path=FOLDER` and more steps.

# %%
from pathlib import Path

import gsx


class Shown:
    """A picture, shown by a notebook."""

    def __init__(self, picture):
        gsx.write_image("shown.png", picture)
        self.png = Path("shown.png").read_bytes()

    def _repr_png_(self):
        return self.png


run = gsx.train("scene.width=160", "scene.height=120", "scene.samples=4", "eval.zoom=[1,2]", iterations=150)
run.step, run.scene.test[0].name

# %% [markdown]
# A held-out view: what the model shows, and what the camera saw.

# %%
view = run.scene.test[0]
Shown(run.render(view))

# %%
Shown(view.image())

# %% [markdown]
# The same camera four times as fine. The built-in scene knows the truth at any resolution, photographs do up to their
# own; so zoomed pictures are measured, not just admired.

# %%
window = view.camera.zoom(4).crop(left=100, top=240, width=160, height=120)
Shown(run.render(window))

# %%
found = run.evaluate(zoom=[1, 2, 4])
{zoom: (round(entry["psnr"], 2), round(entry["enlarged_psnr"], 2)) for zoom, entry in found["zoom"].items()}

# %% [markdown]
# Each pair: PSNR of the zoomed render, and of the x1 render enlarged. A render that loses to its own enlargement adds
# artefacts, not detail. What to do about it is on the page about zooming in.
#
# One file to send, that opens in any browser without network, and one for other programs:

# %%
[run.export(name).name for name in ("model.html", "model.ply")]

# %%
splats = gsx.load("model.ply", raster=run.run.raster)
len(splats.gaussians.means), run.report.name
