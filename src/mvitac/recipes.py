"""Recipes: functions that return a whole ``Run``, each a ``replace`` of another, so that the difference documents it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace

from mvitac.datasets.base import DatasetConfig
from mvitac.datasets.calandra.reader import CalandraConfig
from mvitac.datasets.simulated import GraspsConfig, MaterialsConfig
from mvitac.methods.base import MethodConfig
from mvitac.methods.mvitac import MViTacConfig
from mvitac.nn.encoders import SCRATCH, EncoderConfig
from mvitac.registry import default, unknown
from mvitac.run import Optim, Run
from mvitac.transforms.random_views import Augment, ViewAugment


def paper(data: DatasetConfig) -> Run:
    """As printed in the paper: ResNet-18 from ImageNet, Adam at lr .03 without a schedule, batch 256, 240 epochs.

    Grayscale views are left out for grasping (appendix B). One 24 GB GPU. What the paper leaves open (m, lambda_inter,
    hidden width) is said in the method's fields. lr .03 is very high for Adam; expect to see what it does.
    """
    views = ViewAugment(grayscale=0.0) if isinstance(data, (GraspsConfig, CalandraConfig)) else ViewAugment()
    return Run(recipe="paper", data=data, augment=Augment(vision=views, touch=views))


def authors(data: DatasetConfig) -> Run:
    """The choices of the authors' released code (FACTS section 1), without its defects.

    Against `paper`: lr 1e-3 with weight decay 1e-6 and StepLR, wide heads with dropout, flips that come out at 25 %,
    grayscale also for grasping, the two gels of a stacked pair augmented independently. Not repeated: key heads that are
    never updated, key towers that do not start as copies, and a last short batch (kept there, dropped here).
    """
    views = ViewAugment(flip=0.25, grayscale=0.2)
    base = paper(data)
    return replace(
        base,
        recipe="authors",
        method=MViTacConfig(hidden=2048, dropout=0.5),
        optim=Optim(lr=1e-3, eps=1e-8, weight_decay=1e-6, schedule="step"),
        augment=replace(base.augment, vision=views, touch=replace(views, independent_sensors=True)),
    )


def modern(data: DatasetConfig) -> Run:
    """What current practice does, each change with its reason, and what it was worth in 300 steps of `demo`'s networks with
    momentum keys (docs/results/ablation.md; "level": within the noise).

    - keys end-to-end: gradients through both views instead of a momentum tower, as in SimCLR. After 1,150 steps 10 points
      of category, 8 of rough and nearly twice the retrieval of momentum keys, for steps that take a third to a half as
      much again (docs/results/materials_1150.md).
    - inter-modal losses of all pairs of views, which are there anyway, and no flips of touch, which no real press shows:
      together 3 points of category (4 by touch, 2.7 by vision) on top of that, behind on nothing (the same page); the
      flips alone 1.8, all pairs 1.1, neither apart. Other methods gain 2 to 2.6 by leaving out the flips.
    - AdamW 1e-3 with warm-up and cosine (MoCo v3): Adam at a constant .03 throws the ImageNet start away. From scratch,
      too, 8 points of category (one seed).
    - BatchNorm in the heads (SimCLR v2, MoCo v3): keeps the embeddings from collapsing early at small batches.
      Level (three seeds: without it +1.2, p .61).
    - momentum .99 rising to 1 (BYOL, MoCo v3) for the methods that have one: the keys settle as the queries do.
      Level from 0 to .999 (one seed).
    - one-per-touch batches: consecutive frames of one touch are near-duplicates, and as negatives they teach nonsense.
      Level on simulated touches, which have no consecutive frames (one seed).
    - same-touch positives: two views of one image share lamp, background and sensor, which solves L_vv and L_tt without
      looking at the material (docs/simulator.md has the figures); another row of the touch shares only the thing. After
      1,150 steps 21 points of category, 7 of soft, 20 of rough, and 31 of category with end-to-end keys, which are worth
      nothing without: the largest ingredient. Not for grasps: rows of one differ by before, during and after, and what
      tells these apart is the contact itself.
    - all four losses, also where positives are of the same image: on simulated grasps leaving out the intra-modal ones is
      worth 6.7 points (docs/results/grasps_1150.md), seen on test; not taken before another world has shown it.
    - bf16 where the hardware computes it, else fp32 (precision auto): where torch emulates bf16 a step takes ten times as
      long and more. Scores of the two are level but for one of nine (docs/speed.md).
    """
    base = paper(data)
    phased = isinstance(data, (GraspsConfig, CalandraConfig))
    return replace(
        base,
        recipe="modern",
        method=MViTacConfig(head_norm=True, keys="end-to-end", pairs="all", momentum_end=1.0),
        optim=Optim(name="adamw", lr=1e-3, eps=1e-8, weight_decay=1e-4, schedule="cosine", warmup=0.05),
        sampler="one-per-touch",
        positives="same-image" if phased else "same-touch",
        augment=replace(base.augment, touch=replace(base.augment.touch, flip=0.0)),
        precision="auto",
    )


def demo(data: DatasetConfig) -> Run:
    """`modern` in minutes on a laptop's CPU: ResNet-10 from scratch at 48 px, 1,150 steps of 64 pairs.

    - the paper's momentum keys: it is there to show the paper's method.
    - ResNet-10 (timm's resnet10t) at 48 px, for more steps in the same minutes; its score against ResNet-18 is not measured.
    - batch 64 for twice the steps of batch 128, and temperature .2 (docs/simulator.md has the scores of each).
    - whole images are probed at 72 px, the scale at which crops of them were learned.
    - momentum .9 throughout: keys at .99 rising to 1 remember more steps than a short run has.
    - crops of 40 % and more, no grayscale, lr 2e-3: easier views for few steps.
    """
    base = modern(data)
    views = ViewAugment(scale=(0.4, 1.0), grayscale=0.0)
    return replace(
        base,
        recipe="demo",
        method=MViTacConfig(head_norm=True, momentum=0.9, temperature=0.2),
        optim=replace(base.optim, lr=2e-3),
        encoder=EncoderConfig(trunk="resnet10t", weights=SCRATCH),
        augment=Augment(size=48, whole=72, vision=views, touch=views),
        batch_size=64,
        steps=1150,
        eval_every=500,
    )


def quick(data: DatasetConfig) -> Run:
    """`demo` in a third of the time: end-to-end keys instead of the paper's momentum keys, 1,200 steps of 32 pairs.

    This is what `mvitac demo` trains, so that it takes at most 12 minutes on two cores without fast bf16.

    - keys end-to-end, inter-modal losses of all pairs of views, no flips of touch, as in `modern`: a pair takes half as
      much time again, and teaches far more. The paper's momentum keys are in `demo`, which the published tables use.
    - batch 32 for twice the steps of batch 64, and the learning rate divided by the square root of 2.
    - batch and number of steps were chosen on split val, never on test (docs/simulator.md).
    """
    base = demo(data)
    return replace(
        base,
        recipe="quick",
        method=replace(base.method, keys="end-to-end", pairs="all"),  # type: ignore[call-arg]
        optim=replace(base.optim, lr=1.4e-3),
        augment=replace(base.augment, touch=replace(base.augment.touch, flip=0.0)),
        batch_size=32,
        steps=1200,
    )


def smoke(data: DatasetConfig) -> Run:
    """`demo` in seconds, for tests: a tiny trunk at 32 px, batch 16, 8 steps. Its scores mean nothing."""
    base = demo(data)
    return replace(
        base,
        recipe="smoke",
        encoder=EncoderConfig(trunk="mvitac_tiny", weights=SCRATCH),
        method=MViTacConfig(hidden=32, out=16),
        augment=replace(base.augment, size=32, whole=None),
        batch_size=16,
        steps=8,
        precision="fp32",
        log_every=2,
        eval_every=4,
    )


RECIPES: dict[str, Callable[[DatasetConfig], Run]] = {
    f.__name__: f for f in (paper, authors, modern, demo, quick, smoke)
}


def with_method(run: Run, method: str) -> Run:
    """``run`` with another method: its own defaults, but for what the run's recipe changed in fields that both have.

    So a method that is compared with MViTac gets the head and the momentum that the recipe's budget asks for.
    """
    if method == run.method.name:
        return run
    usual = default(MethodConfig, run.method.name)
    changed = {f.name: getattr(run.method, f.name) for f in fields(usual)}
    changed = {name: value for name, value in changed.items() if value != getattr(usual, name)}
    chosen = default(MethodConfig, method)
    mine = {f.name for f in fields(chosen)}
    return replace(run, method=replace(chosen, **{name: value for name, value in changed.items() if name in mine}))


def recipe(name: str, data: DatasetConfig | None = None) -> Run:
    """The named recipe on ``data`` (default: simulated materials); ValueError names the choices."""
    if name not in RECIPES:
        raise unknown("recipe", name, RECIPES)
    return RECIPES[name](data or MaterialsConfig())
