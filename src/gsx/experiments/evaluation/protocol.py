"""The protocol of an evaluation: what two results must share to be compared."""

import hashlib
import json
from typing import Any

from gsx.core.data.scene import Scene
from gsx.experiments.evaluation.eval_options import EvalOptions

MASKED = {
    "excluded": "PSNR and SSIM over the pixels that count, the others black in all pictures",
    "black": "PSNR and SSIM over all pixels, those that do not count black in all pictures",
}
"""Rules for masks, by `eval.masks`."""


def protocol_of(scene: Scene, options: EvalOptions, lpips_name: str) -> dict[str, Any]:
    """Returns what two results must share to be compared, and its hash."""
    protocol: dict[str, Any] = {
        "scene": {key: value for key, value in scene.provenance.items() if key != "notes"},
        "test_views": [view.name for view in scene.test],
        "train_views": len(scene.train),
        "size": list((*scene.test, *scene.train)[0].camera.size),
        "background": scene.background.tolist(),
        "quantised_to_8_bit": options.quantise,
        "psnr": "mean over views of 20 log10(1/sqrt(MSE)), all pixels and channels",
        "ssim": options.ssim,
        "lpips": lpips_name,
        "enlarged": "x1 render, antialiased Keys bicubic",
    }
    if "masks" in protocol["scene"]:
        protocol |= {"masks": MASKED[options.masks]}
    if options.quantise and options.rounding != "nearest":
        protocol |= {"rounding": options.rounding}
    if options.clamp and not options.quantise:
        protocol |= {"clamped": True}
    if options.colours == "fitted":
        protocol |= {"colours": "3x4 matrix a view, least squares on the left half; all figures of the right half"}
    if options.poses == "aligned":
        protocol |= {"poses": "aligned to the model by the left half; all figures of the right half"}
    text = json.dumps(protocol, sort_keys=True, default=str)
    # the choice of zooms changes no figure, so it does not enter the hash
    return protocol | {"zoom": list(options.zoom), "hash": hashlib.sha256(text.encode()).hexdigest()[:16]}
