"""How each remover is trained: what it makes of a batch, and what that costs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from pipeline.errors import UserError
from pipeline.removal import autoencoder, critics, quan, starts, wen
from pipeline.removal.autoencoder import ContextualAutoencoder, Scales, multi_scale_loss
from pipeline.removal.critics import AttentiveCritic, Critic, PatchCritic
from pipeline.removal.losses import wen_loss
from pipeline.removal.quan import QuanNet
from pipeline.removal.samples import Batch
from pipeline.removal.wen import Frames, WenNet, mend

MapLoss = Callable[[Sequence[Tensor], Tensor], Tensor]


class Outcome(NamedTuple):
    """The generator's own loss, and what its discriminator looks at: fake, real, and a map."""

    loss: Tensor
    fake: Tensor
    real: Tensor
    attention: Tensor


@dataclass(frozen=True)
class Added:
    """What is added to the published losses, so that minutes of training get somewhere.

    quan_squares: the weight of mean squares beside the mean absolutes. quan_guides: of two products
    that read the change a photo needs, and its drops, out of the decoder; they are not part of the
    network. wen_mended: of mean squares of the photo where the map says clear, of the network elsewhere.
    """

    quan_squares: float = 0
    quan_guides: float = 0
    wen_mended: float = 0

    __pydantic_config__: ClassVar = {"extra": "forbid", "allow_inf_nan": False}  # of params.yaml

    def __post_init__(self) -> None:
        if min(self.quan_squares, self.quan_guides, self.wen_mended) < 0:
            raise ValueError("weights of losses are 0 or more")


class AttganRecipe(nn.Module):
    """Qian et al. (CVPR 2018), section 4: maps of all steps, three scales, perceptual loss.

    attention: the attentive-recurrent network; frozen unless `train_attention`. steps: how many
    recurrent steps are made in training (restoring makes as many as are published).
    """

    multiple, clips = autoencoder.MULTIPLE, False

    def __init__(
        self, attention: nn.Module, map_loss: MapLoss, *, train_attention: bool, steps: int
    ) -> None:
        super().__init__()
        self.attention, self.autoencoder = attention, ContextualAutoencoder()
        self.map_loss, self.steps, self.train_attention = map_loss, steps, train_attention
        attention.requires_grad_(train_attention)

    def begin(self, seed: int) -> None:
        starts.start_attgan(self.autoencoder, seed)

    def outcome(self, batch: Batch, perceptual: nn.Module | None) -> Outcome:
        rainy, clean, drops = (part[:, 0] for part in batch)
        bgr, dry = rainy.flip(1), clean.flip(1)
        with torch.set_grad_enabled(self.train_attention):
            maps = [found.float() for found in self.attention(bgr, self.steps)]
        found = Scales(*(scale.float() for scale in self.autoencoder(bgr, maps[-1])))
        loss = multi_scale_loss(found, dry)
        if self.train_attention:
            loss = loss + self.map_loss(maps, drops)
        if perceptual is not None:
            loss = loss + perceptual(found.full, dry)
        return Outcome(loss, found.full, dry, maps[-1].detach())

    def carry(self, batch: Batch) -> Tensor:
        return self.outcome(batch._replace(clean=batch.rainy), None).loss

    def restored(self, rainy: Tensor) -> Tensor:
        bgr = rainy[:, 0].flip(1)
        return self.autoencoder(bgr, self.attention(bgr, self.steps)[-1]).full.flip(1)


class QuanRecipe(nn.Module):
    """Quan et al. (ICCV 2019): the mean absolute difference; the edges are computed from the photo."""

    multiple, clips = quan.MULTIPLE, False

    def __init__(self, added: Added, *, published_edges: bool) -> None:
        super().__init__()
        self.network, self.published_edges, self.added = QuanNet(), published_edges, added
        self.guides = nn.ModuleList(nn.Conv2d(channels, 4, 1) for channels in (128, 64))

    def begin(self, seed: int) -> None:
        starts.start_quan(self.network, seed)
        for guide in self.guides.parameters():
            nn.init.zeros_(guide)

    def outcome(self, batch: Batch, perceptual: nn.Module | None) -> Outcome:
        rainy, clean, drops = (part[:, 0] for part in batch)
        *insides, last = self.network.decoded(rainy, published=self.published_edges)
        found = self.network.dec1_0(last).float()
        loss = F.l1_loss(found, clean) + self.added.quan_squares * F.mse_loss(found, clean)
        if self.added.quan_guides > 0:
            wanted = torch.cat([clean - rainy, drops], 1)
            loss = loss + self.added.quan_guides * self._guided(insides, wanted)
        return Outcome(loss, found, clean, drops)

    def _guided(self, insides: Sequence[Tensor], wanted: Tensor) -> Tensor:
        total = wanted.new_zeros(())
        for guide, inside in zip(self.guides, insides, strict=True):
            read = guide(inside).float()
            target = F.adaptive_avg_pool2d(wanted, read.shape[-2:])
            total = total + F.mse_loss(read, target)
        return total

    def carry(self, batch: Batch) -> Tensor:
        return self.outcome(batch._replace(clean=batch.rainy), None).loss

    def restored(self, rainy: Tensor) -> Tensor:
        return self.network(rainy[:, 0], published=self.published_edges)


class WenRecipe(nn.Module):
    """Wen et al. (ICRA 2023): five frames, a map of clear pixels, and single pictures in between."""

    multiple, clips = wen.MULTIPLE, True

    def __init__(self, added: Added) -> None:
        super().__init__()
        self.network, self.added = WenNet(), added

    def begin(self, seed: int) -> None:
        starts.start_wen(self.network, seed)

    def outcome(self, batch: Batch, perceptual: nn.Module | None) -> Outcome:
        rainy, clean = batch.rainy * 2 - 1, batch.clean * 2 - 1
        found = Frames(*(part.float() for part in self.network(rainy)))
        loss = wen_loss(found, rainy, clean, batch.drops, perceptual)
        if self.added.wen_mended > 0:
            mended = mend(rainy, found.full, found.clear)
            loss = loss + self.added.wen_mended * F.mse_loss(mended, clean)
        return Outcome(loss, found.full.flatten(1, 2), clean.flatten(1, 2), batch.drops[:, 0])

    def carry(self, batch: Batch) -> Tensor:
        """How badly the layers down and up, without all others between them, copy the photo."""
        frames = batch.rainy.flatten(0, 1) * 2 - 1
        x = 0.5 * self.network.main_branch(frames)  # 0.5: the gate as it begins
        return 25 * F.mse_loss(self.network.upsample_block(x).float(), frames)

    def restored(self, rainy: Tensor) -> Tensor:
        frames = rainy * 2 - 1
        found = self.network(frames)
        full = found.full
        if self.added.wen_mended > 0:
            full = mend(frames, full, found.clear)
        return (full[:, full.shape[1] // 2] + 1) / 2


AnyRecipe = AttganRecipe | QuanRecipe | WenRecipe


def recipe_of(
    method: str, seed: int, *, attention: nn.Module | None, map_loss: MapLoss,
    train_attention: bool, steps: int, published_edges: bool, added: Added = Added(),
) -> AnyRecipe:  # fmt: skip
    """The recipe of `attgan`, `quan` or `wen` with its starting weights; attgan needs `attention`."""
    recipe: AnyRecipe
    if method == "attgan":
        assert attention is not None
        recipe = AttganRecipe(attention, map_loss, train_attention=train_attention, steps=steps)
    elif method == "quan":
        recipe = QuanRecipe(added, published_edges=published_edges)
    else:
        recipe = WenRecipe(added)
    recipe.begin(seed)
    return recipe


def critic_of(recipe: AnyRecipe, seed: int) -> Critic:
    """The discriminator that a remover was published with; UserError for Quan's, which has none."""
    torch.manual_seed(seed)
    if isinstance(recipe, QuanRecipe):
        raise UserError(
            "Quan et al. train without a discriminator.", "Set train_remover.quan.adversarial to 0."
        )
    return AttentiveCritic() if isinstance(recipe, AttganRecipe) else PatchCritic()


def check_crop(recipe: AnyRecipe, crop: int, adversarial: bool) -> None:
    """UserError for crops that a remover, or its discriminator, cannot read."""
    if crop % recipe.multiple:
        raise UserError(
            f"Crops of {crop} pixels are no multiple of {recipe.multiple}, which this network needs.",
            "Change crop under train_remover.",
        )
    if adversarial and isinstance(recipe, AttganRecipe) and crop != critics.SIDE:
        raise UserError(
            f"The attentive discriminator reads {critics.SIDE}x{critics.SIDE} pixels, not {crop}.",
            f"Set crop to {critics.SIDE}, or train_remover.attgan.adversarial to 0.",
        )


def weights_of(recipe: nn.Module) -> Mapping[str, Tensor]:
    """The networks' tensors under their published names, as `restore` loads them."""
    parts = [(*name.split(".", 1), value) for name, value in recipe.state_dict().items()]
    return {name: value for part, name, value in parts if part != "guides"}
