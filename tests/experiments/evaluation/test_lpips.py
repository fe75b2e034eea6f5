"""LPIPS with random weights in files shaped like torchvision's and the lpips package's, against plain convolutions."""

import io
import math
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor
from torch.nn.functional import conv2d, max_pool2d

from gsx.core.errors import InputError
from gsx.experiments.evaluation.lpips import Lpips, LpipsOptions, load_lpips

# layers of torchvision's `features`: number, channels in and out, kernel; the head reads the last of each stage
VGG = {
    0: (3, 64, 3), 2: (64, 64, 3), 5: (64, 128, 3), 7: (128, 128, 3), 10: (128, 256, 3), 12: (256, 256, 3),
    14: (256, 256, 3), 17: (256, 512, 3), 19: (512, 512, 3), 21: (512, 512, 3), 24: (512, 512, 3), 26: (512, 512, 3),
    28: (512, 512, 3),
}  # fmt: skip
ALEX = {0: (3, 64, 11), 3: (64, 192, 5), 6: (192, 384, 3), 8: (384, 256, 3), 10: (256, 256, 3)}
LAYERS = {"vgg": VGG, "alex": ALEX}
READ_AFTER = {"vgg": (2, 7, 14, 21, 28), "alex": (0, 3, 6, 8, 10)}
SIZE = 36


def random_trunk(layers: dict[int, tuple[int, int, int]], generator: torch.Generator) -> dict[str, Tensor]:
    trunk = OrderedDict()
    for number, (entering, leaving, kernel) in layers.items():
        spread = (2 / (entering * kernel**2)) ** 0.5
        trunk[f"features.{number}.weight"] = spread * torch.randn(
            leaving, entering, kernel, kernel, generator=generator
        )
        trunk[f"features.{number}.bias"] = 0.1 * torch.randn(leaving, generator=generator)
    trunk["classifier.1.weight"] = torch.randn(4, 4, generator=generator)  # real files hold more than LPIPS uses
    return trunk


def random_head(net: str, generator: torch.Generator) -> dict[str, Tensor]:
    widths = [LAYERS[net][number][1] for number in READ_AFTER[net]]
    return {f"lin{i}.model.1.weight": torch.rand(1, width, 1, 1, generator=generator) for i, width in enumerate(widths)}


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Path, Path]]:
    folder, generator = tmp_path_factory.mktemp("lpips"), torch.Generator().manual_seed(1)
    files = {net: (folder / f"{net}_trunk.pth", folder / f"{net}_head.pth") for net in LAYERS}
    for net, (trunk, head) in files.items():
        torch.save(random_trunk(LAYERS[net], generator), trunk)
        torch.save(random_head(net, generator), head)
    return files


def options(trunk: Path | str, head: Path | str, net: str = "vgg", input_range: str = "unit") -> LpipsOptions:
    return LpipsOptions(trunk=str(trunk), head=str(head), net=net, input_range=input_range)


@pytest.fixture(scope="module")
def network(weights: dict[str, tuple[Path, Path]]) -> Callable[[str, str], Lpips]:
    loaded = {net: load_lpips(options(*weights[net], net)) for net in LAYERS}
    assert None not in loaded.values()
    return loaded.__getitem__


def pictures(seed: int = 0) -> tuple[Tensor, Tensor]:
    return tuple(torch.rand(2, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(seed)))


def vgg_features(picture: Tensor, trunk: dict[str, Tensor]) -> list[Tensor]:
    outputs, x = [], picture[None]
    for number in VGG:
        if number in (5, 10, 17, 24):
            x = max_pool2d(x, 2, 2)
        x = conv2d(x, trunk[f"features.{number}.weight"], trunk[f"features.{number}.bias"], padding=1).clamp_min(0)
        outputs += [x[0]] if number in READ_AFTER["vgg"] else []
    return outputs


def alex_features(picture: Tensor, trunk: dict[str, Tensor]) -> list[Tensor]:
    def layer(x: Tensor, number: int, stride: int, padding: int) -> Tensor:
        weight, bias = trunk[f"features.{number}.weight"], trunk[f"features.{number}.bias"]
        return conv2d(x, weight, bias, stride, padding).clamp_min(0)

    first = layer(picture[None], 0, 4, 2)
    second = layer(max_pool2d(first, 3, 2), 3, 1, 2)
    third = layer(max_pool2d(second, 3, 2), 6, 1, 1)
    fourth = layer(third, 8, 1, 1)
    return [x[0] for x in (first, second, third, fourth, layer(fourth, 10, 1, 1))]


def distance_by_hand(
    image: Tensor, target: Tensor, trunk: dict[str, Tensor], head: dict[str, Tensor], net: str
) -> float:
    """Zhang et al. 2018, equation 1, in float64; pictures as they enter the normalisation."""
    shift = torch.tensor([-0.030, -0.088, -0.188], dtype=torch.float64).view(3, 1, 1)
    scale = torch.tensor([0.458, 0.448, 0.450], dtype=torch.float64).view(3, 1, 1)
    trunk = {name: value.double() for name, value in trunk.items()}
    features = vgg_features if net == "vgg" else alex_features
    first, second = (features((picture.double() - shift) / scale, trunk) for picture in (image, target))
    total = 0.0
    for stage, (a, b) in enumerate(zip(first, second, strict=True)):
        weight = head[f"lin{stage}.model.1.weight"].double().view(-1)
        _, height, width = a.shape
        difference = a / a.square().sum(0).sqrt() - b / b.square().sum(0).sqrt()
        total += float(torch.einsum("c,chw->", weight, difference.square())) / (height * width)
    return total


@pytest.mark.parametrize("net", ["vgg", "alex"])
def test_distance_equals_plain_convolutions(net: str, network: Callable, weights: dict) -> None:
    image, target = pictures()
    trunk, head = (torch.load(path, weights_only=True) for path in weights[net])
    assert network(net).distance(image, target) == pytest.approx(
        distance_by_hand(image, target, trunk, head, net), rel=1e-4
    )


@pytest.mark.parametrize("net", ["vgg", "alex"])
def test_distance_is_zero_at_identity_symmetric_and_grows(net: str, network: Callable) -> None:
    image, target = pictures()
    assert network(net).distance(image, image) == 0
    there, back = network(net).distance(image, target), network(net).distance(target, image)
    assert there == pytest.approx(back, rel=1e-5)
    little = network(net).distance(image, image + 0.1 * (target - image))
    assert 0 < little < there


def test_input_range_is_named_and_changes_what_enters(network: Callable, weights: dict) -> None:
    image, target = pictures()
    signed = load_lpips(options(*weights["alex"], "alex", "signed"))
    half = signed.distance((image + 1) / 2, (target + 1) / 2)
    assert half == pytest.approx(network("alex").distance(image, target), rel=1e-5)
    assert "lpips_alex, input in [-1,1], trunk " in signed.name
    assert "lpips_alex, input in [0,1], trunk " in network("alex").name


def test_name_tells_weights_apart(weights: dict, tmp_path: Path) -> None:
    torch.save(random_head("alex", torch.Generator().manual_seed(9)), tmp_path / "other.pth")
    one = load_lpips(options(*weights["alex"], "alex")).name
    other = load_lpips(options(weights["alex"][0], tmp_path / "other.pth", "alex")).name
    assert one.split(", head")[0] == other.split(", head")[0]
    assert one != other


def test_without_weights_there_is_no_network() -> None:
    assert load_lpips(options("", "")) is None


@pytest.mark.parametrize(("trunk", "head", "missing"), [("trunk.pth", "", "head"), ("", "head.pth", "trunk")])
def test_one_file_without_the_other_is_refused(trunk: str, head: str, missing: str) -> None:
    with pytest.raises(InputError, match=rf"metrics\.lpips\.{missing} is missing"):
        load_lpips(options(trunk, head))


def test_files_that_cannot_be_read_are_named_with_their_option(weights: dict, tmp_path: Path) -> None:
    trunk, head = weights["alex"]
    with pytest.raises(InputError, match=r"metrics\.lpips\.trunk=.*absent\.pth"):
        load_lpips(options(tmp_path / "absent.pth", head, "alex"))
    with pytest.raises(InputError, match=r"metrics\.lpips\.head=.* \(Is a directory\)"):
        load_lpips(options(trunk, tmp_path, "alex"))


def saved(content: object) -> bytes:
    stream = io.BytesIO()
    torch.save(content, stream)
    return stream.getvalue()


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "it is empty"),
        (b"<html>not found</html>", "it is a web page"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n", "it is a Git LFS pointer"),
        (b"hello", "it is no file of torch.save"),
        (b"\x02\0\0\0\0\0\0\0{}", "it is a safetensors file"),
        (b"PK\x03\x04 and no more", "it is damaged, or holds other things than tensors"),
        (b"\x80\x02junk", "it is damaged, or holds other things than tensors"),
        (saved(torch.nn.Linear(2, 2)), "it is damaged, or holds other things than tensors"),
        (saved(torch.zeros(3)), "it holds a Tensor, not a state dict"),
        (saved([torch.zeros(3)]), "it holds a list, not a state dict"),
    ],
)
def test_a_file_that_is_no_weights_is_refused_in_one_sentence(
    content: bytes, reason: str, weights: dict, tmp_path: Path
) -> None:
    """The whole message is ours: torch's own advises to run what the file holds."""
    file = tmp_path / "page.pth"
    file.write_bytes(content)
    with pytest.raises(InputError) as caught:
        load_lpips(options(file, weights["alex"][1], "alex"))
    start, end = f"metrics.lpips.trunk={file} cannot be read as weights ({reason}", "): give a local .pth file"
    assert str(caught.value).startswith(start)
    assert end in str(caught.value)
    assert "torch.load" not in str(caught.value)
    assert "\n" not in str(caught.value)


def test_weights_that_are_not_finite_are_refused_by_name(weights: dict, tmp_path: Path) -> None:
    head = torch.load(weights["alex"][1], weights_only=True)
    head["lin2.model.1.weight"][0, 5] = math.nan
    torch.save(head, tmp_path / "head.pth")
    with pytest.raises(InputError, match=r"the head file lacks finite 'lin2\.model\.1\.weight'\): check both"):
        load_lpips(options(weights["alex"][0], tmp_path / "head.pth", "alex"))


def test_files_that_are_swapped_or_of_the_other_net_are_refused_with_the_remedy(weights: dict) -> None:
    with pytest.raises(InputError, match=r"lacks finite 'features\.0\.weight'\): swap them"):
        load_lpips(options(*weights["alex"][::-1], "alex"))
    with pytest.raises(InputError, match=r"64x3x11x11 instead of 64x3x3x3 numbers\): set metrics\.lpips\.net=alex"):
        load_lpips(options(*weights["alex"], "vgg"))


def test_files_of_another_network_are_refused(weights: dict) -> None:
    for trunk, head in [(weights["alex"][0], weights["vgg"][1]), (weights["vgg"][0], weights["alex"][1])]:
        for net in LAYERS:
            with pytest.raises(InputError, match=f"do not fit net '{net}'"):
                load_lpips(options(trunk, head, net))


def test_unknown_net_or_range_is_refused(weights: dict) -> None:
    with pytest.raises(InputError, match="net 'squeeze'"):
        load_lpips(options(*weights["alex"], "squeeze"))
    with pytest.raises(InputError, match="input_range 'bytes'"):
        load_lpips(options(*weights["alex"], "alex", "bytes"))
