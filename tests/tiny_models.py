"""The three diffusion pipelines with few, random weights, made in code and saved as on a hub."""

import json
import math
from pathlib import Path
from typing import Any

import torch
from diffusers import (
    AutoencoderKL,
    DDIMScheduler,
    DDPMScheduler,
    EulerAncestralDiscreteScheduler,
    EulerDiscreteScheduler,
    StableDiffusionLatentUpscalePipeline,
    StableDiffusionUpscalePipeline,
    StableDiffusionXLPipeline,
    UNet2DConditionModel,
)
from torch import Tensor
from torch.nn.functional import interpolate
from transformers import CLIPTextConfig, CLIPTextModel, CLIPTextModelWithProjection, CLIPTokenizer

WIDTH = 32
"""Of text embeddings."""
BEGIN, END = "<|startoftext|>", "<|endoftext|>"


def tokenizer(folder: Path) -> CLIPTokenizer:
    """Byte symbols alone, without merges."""
    printable = [*range(33, 127), *range(161, 173), *range(174, 256)]
    symbols = [chr(byte) for byte in printable] + [chr(256 + n) for n in range(256 - len(printable))]
    words = [*symbols, *(symbol + "</w>" for symbol in symbols), BEGIN, END]
    folder.mkdir(parents=True)
    vocabulary = {word: number for number, word in enumerate(words)}
    (folder / "vocab.json").write_text(json.dumps(vocabulary, ensure_ascii=False), encoding="utf-8")
    (folder / "merges.txt").write_text("#version: 0.2\n", encoding="utf-8")
    ends = {"bos_token": BEGIN, "eos_token": END, "unk_token": END, "pad_token": END}
    told = {"tokenizer_class": "CLIPTokenizer", "model_max_length": 77, **ends}
    (folder / "tokenizer_config.json").write_text(json.dumps(told), encoding="utf-8")
    return CLIPTokenizer.from_pretrained(folder, local_files_only=True)


def text_config(words: CLIPTokenizer) -> CLIPTextConfig:
    """Of a text encoder of two layers."""
    begin, end = words.convert_tokens_to_ids([BEGIN, END])
    return CLIPTextConfig(
        vocab_size=len(words),
        hidden_size=WIDTH,
        intermediate_size=2 * WIDTH,
        projection_dim=WIDTH,
        num_attention_heads=4,
        num_hidden_layers=2,
        max_position_embeddings=77,
        bos_token_id=begin,
        eos_token_id=end,
        pad_token_id=end,
    )


def autoencoder(levels: int, scaling: float, channels: int = 16, **more: Any) -> AutoencoderKL:
    """It reduces by 2^(levels - 1)."""
    return AutoencoderKL(
        latent_channels=4,
        layers_per_block=1,
        norm_num_groups=4,
        block_out_channels=(channels,) * levels,
        down_block_types=("DownEncoderBlock2D",) * levels,
        up_block_types=("UpDecoderBlock2D",) * levels,
        scaling_factor=scaling,
        **more,
    )


def sd_x2_latent(words: CLIPTokenizer) -> StableDiffusionLatentUpscalePipeline:
    """Blocks of the K-diffusion UNet, which needs a fifth channel and pooled text beside 128 numbers for noise."""
    across, up = "KCrossAttnDownBlock2D", "KCrossAttnUpBlock2D"
    unet = UNet2DConditionModel(
        in_channels=8,
        out_channels=5,
        cross_attention_dim=WIDTH,
        attention_head_dim=8,
        block_out_channels=(32, 32, 64, 64),
        layers_per_block=1,
        down_block_types=("KDownBlock2D", across, across, across),
        mid_block_type=None,
        up_block_types=(up, up, up, "KUpBlock2D"),
        act_fn="gelu",
        norm_num_groups=None,
        conv_in_kernel=1,
        conv_out_kernel=1,
        resnet_time_scale_shift="scale_shift",
        time_embedding_type="fourier",
        timestep_post_act="gelu",
        time_cond_proj_dim=128 + WIDTH,
    )
    scheduler = EulerDiscreteScheduler(
        beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear", prediction_type="sample"
    )
    text = CLIPTextModel(text_config(words))
    vae = autoencoder(4, 0.18215)
    return StableDiffusionLatentUpscalePipeline(
        vae=vae, text_encoder=text, tokenizer=words, unet=unet, scheduler=scheduler
    )


def sd_x4(words: CLIPTokenizer) -> StableDiffusionUpscalePipeline:
    """The noise level enters as a class."""
    unet = UNet2DConditionModel(
        in_channels=7,
        out_channels=4,
        cross_attention_dim=WIDTH,
        attention_head_dim=8,
        block_out_channels=(16, 32),
        layers_per_block=1,
        norm_num_groups=8,
        down_block_types=("DownBlock2D", "CrossAttnDownBlock2D"),
        up_block_types=("CrossAttnUpBlock2D", "UpBlock2D"),
        only_cross_attention=(True, False),
        use_linear_projection=True,
        num_class_embeds=1000,
    )
    scheduler = DDIMScheduler(
        beta_start=0.0001,
        beta_end=0.02,
        prediction_type="v_prediction",
        clip_sample=False,
        set_alpha_to_one=False,
        steps_offset=1,
    )
    return StableDiffusionUpscalePipeline(
        vae=autoencoder(3, 0.08333),
        text_encoder=CLIPTextModel(text_config(words)),
        tokenizer=words,
        unet=unet,
        low_res_scheduler=DDPMScheduler(beta_schedule="scaled_linear"),
        scheduler=scheduler,
        safety_checker=None,
        feature_extractor=None,
        watermarker=None,
        max_noise_level=350,
    )


def sdxl_turbo(words: CLIPTokenizer, levels: int = 4, **more: Any) -> StableDiffusionXLPipeline:
    """Saved as text-to-image, as on the hub."""
    times = 8
    unet = UNet2DConditionModel(
        in_channels=4,
        out_channels=4,
        cross_attention_dim=2 * WIDTH,
        attention_head_dim=(2, 4),
        block_out_channels=(16, 32),
        layers_per_block=1,
        norm_num_groups=8,
        down_block_types=("DownBlock2D", "CrossAttnDownBlock2D"),
        up_block_types=("CrossAttnUpBlock2D", "UpBlock2D"),
        transformer_layers_per_block=(1, 1),
        use_linear_projection=True,
        addition_embed_type="text_time",
        addition_time_embed_dim=times,
        projection_class_embeddings_input_dim=6 * times + WIDTH,
    )
    scheduler = EulerAncestralDiscreteScheduler(
        beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear", timestep_spacing="trailing"
    )
    return StableDiffusionXLPipeline(
        vae=autoencoder(levels, 0.13025, force_upcast=True, **more),
        text_encoder=CLIPTextModel(text_config(words)),
        text_encoder_2=CLIPTextModelWithProjection(text_config(words)),
        tokenizer=words,
        tokenizer_2=words,
        unet=unet,
        scheduler=scheduler,
        force_zeros_for_empty_prompt=True,
        add_watermarker=False,
    )


def pictures(count: int, height: int, width: int, generator: torch.Generator) -> Tensor:
    """Soft colours with hard-edged patches on them, [count, 3, height, width]."""
    coarse = (max(2, height // 8), max(2, width // 8))
    soft = interpolate(torch.rand(count, 3, *coarse, generator=generator), size=(height, width), mode="bicubic")
    field = interpolate(torch.rand(count, 1, *coarse, generator=generator), size=(height, width), mode="bilinear")
    colour = torch.rand(count, 3, 1, 1, generator=generator)
    return torch.where(field > 0.6, colour, soft).clamp(0, 1)


@torch.no_grad()
def make_transparent(vae: AutoencoderKL, large: float = 50.0) -> None:
    """Weights of an autoencoder of one level with which latents are the picture, and the picture is given back.

    Residual branches are nil. Groups of the last normalisation hold (s, -s, K, -K): beside K the signal s hardly moves
    its deviation K / sqrt 2, the mean is 0, and silu(x) - silu(-x) = x.
    """
    for name, parameter in vae.named_parameters():
        if ".conv2." in name or "to_out" in name:
            parameter.zero_()
    for part, inputs in ((vae.encoder, 3), (vae.decoder, 4)):
        for layer in (part.conv_in, part.conv_out):
            layer.weight.zero_()
            layer.bias.zero_()
        part.conv_in.bias[2::4], part.conv_in.bias[3::4] = large, -large
        for signal in range(inputs):
            part.conv_in.weight[4 * signal : 4 * signal + 2, signal, 1, 1] = torch.tensor([1.0, -1.0])
        for signal in range(3):
            way_back = torch.tensor([1.0, -1.0]) * large / math.sqrt(2)
            part.conv_out.weight[signal, 4 * signal : 4 * signal + 2, 1, 1] = way_back
    vae.encoder.conv_out.bias[4:] = -30  # log variance: nothing is left to chance
    for layer, channels in ((vae.quant_conv, 8), (vae.post_quant_conv, 4)):
        layer.weight.copy_(torch.eye(channels)[:, :, None, None])
        layer.bias.zero_()


def train_denoiser(pipe: Any, steps: int) -> None:
    """Teach a UNet to see the little noise that image-to-image adds to latents."""
    generator = torch.Generator().manual_seed(0)
    shown = pictures(32, 16, 16, generator)
    with torch.no_grad():
        latents = pipe.vae.encode(2 * shown - 1).latent_dist.mean * pipe.vae.config.scaling_factor
        words, _, pooled, _ = pipe.encode_prompt("sharp", do_classifier_free_guidance=False)
    told = {"text_embeds": pooled.expand(4, -1), "time_ids": torch.tensor([[16.0, 16, 0, 0, 16, 16]]).expand(4, -1)}
    optimiser = torch.optim.Adam(pipe.unet.parameters(), lr=5e-3)
    for _ in range(steps):
        picked, when = (torch.randint(low, high, (4,), generator=generator) for low, high in ((0, 32), (9, 59)))
        kept = pipe.scheduler.alphas_cumprod[when].view(-1, 1, 1, 1)
        noise = torch.randn(latents[picked].shape, generator=generator)
        noisy = kept.sqrt() * latents[picked] + (1 - kept).sqrt() * noise
        guess = pipe.unet(noisy, when, words.expand(4, -1, -1), added_cond_kwargs=told).sample
        loss = (guess - noise).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()


def transparent_turbo(words: CLIPTokenizer, scaling: float) -> StableDiffusionXLPipeline:
    """SDXL-Turbo whose latents are the picture times `scaling`."""
    pipe = sdxl_turbo(words, levels=1)
    pipe.vae.register_to_config(scaling_factor=scaling)
    make_transparent(pipe.vae)
    return pipe


def save_models(folder: Path) -> dict[str, Path]:
    """The three, by the names that gsx gives them, with random weights; `still`: SDXL-Turbo that changes nothing;
    `useful`: one that removes noise."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        words = tokenizer(folder / "words")
        for build in (sd_x2_latent, sd_x4, sdxl_turbo):
            build(words).save_pretrained(folder / build.__name__)
        still = transparent_turbo(words, 1000.0)  # beside which the noise is nothing
        torch.nn.init.zeros_(still.unet.conv_out.weight)
        torch.nn.init.zeros_(still.unet.conv_out.bias)
        still.save_pretrained(folder / "still")
        useful = transparent_turbo(words, 1.0)
        train_denoiser(useful, 40)
        useful.save_pretrained(folder / "useful")
    return {path.name: path for path in folder.iterdir()}
