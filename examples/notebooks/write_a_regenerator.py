# %% [markdown]
# # Write a regenerator
#
# A regenerator redraws what the model renders while it trains; training continues on the result. It can be a diffusion
# model, a network that learnt the scene, or any function of a picture: here an unsharp mask on an enlarged picture.

# %%
from pathlib import Path

_ = Path("my_regenerator.py").write_text('''
import torch
from torch.nn.functional import avg_pool2d, interpolate, pad


def sharpened(image, scale, prompt, seed, strength, amount=0.5):
    """Enlarged, its difference to a blurred copy added: [3, h, w] in [0, 1] becomes [3, scale h, scale w]."""
    large = interpolate(image[None], scale_factor=scale, mode="bicubic", align_corners=False)
    blurred = avg_pool2d(pad(large, (1, 1, 1, 1), mode="replicate"), 3, stride=1)
    return (large + amount * (large - blurred))[0].clamp(0, 1)
''')

# %% [markdown]
# It is tried on its own first: a picture in, a larger picture out.

# %%
import sys

import torch

sys.path.insert(0, ".")
from my_regenerator import sharpened

sharpened(torch.rand(3, 8, 12), scale=2, prompt="", seed=0, strength=1.0).shape

# %% [markdown]
# Then it is named: `upscale` asks it for zoomed-in pictures while the model trains. Its pictures are checked (colours,
# agreement with what they were made from), and reduced to exactly the photograph they came from.

# %%
import gsx

run = gsx.train(
    "scene.width=96", "scene.height=72", "scene.samples=2", "eval.zoom=[1,2]",
    "augmenter=upscale", "regenerator/upscale=callable", "regenerator.upscale.function=my_regenerator:sharpened",
    "+regenerator.upscale.arguments.amount=0.8",
    backbone="gs3d", iterations=120,
)  # fmt: skip
sorted(path.name for path in (run.folder / "pseudo").glob("*.png"))[:3]

# %% [markdown]
# What was redrawn, the result, and their difference (four times, around grey), as the report shows them:


# %%
class Shown:
    """A file, shown by a notebook."""

    def __init__(self, path):
        self.png = path.read_bytes()

    def _repr_png_(self):
        return self.png


Shown(sorted((run.folder / "pseudo").glob("*.png"))[0])

# %% [markdown]
# Did it help? Only a run without it can tell, with the same seed and steps; a claim needs several seeds.

# %%
plain = gsx.train(
    "scene.width=96", "scene.height=72", "scene.samples=2", "eval.zoom=[1,2]", backbone="gs3d", iterations=120
)
{name: round(one.evaluate()["zoom"]["2"]["psnr"], 2) for name, one in (("with", run), ("without", plain))}
