"""Recipes: functions that return a complete ``Run``. Each changes another recipe, so the code shows the differences."""

from collections.abc import Callable
from dataclasses import fields, replace

from mvitac.data.pack import Pack
from mvitac.datasets.base import DatasetConfig
from mvitac.datasets.pack import PackConfig
from mvitac.methods.base import MethodConfig
from mvitac.methods.mvitac import MViTacConfig
from mvitac.nn.encoders import SCRATCH, EncoderConfig, Encoders
from mvitac.registry import check_known, default
from mvitac.run import Optim, Run
from mvitac.transforms.random_views import Augment, ViewAugment


def paper(data: DatasetConfig, phased: bool) -> Run:
    """The settings printed in the paper: ResNet-18 from ImageNet, Adam at lr .03 without a schedule, batch 256, 240 epochs.

    No grayscale views for grasping (appendix B). Needs one 24 GB GPU. The fields of ``MViTacConfig`` say which values the
    paper leaves open (m, lambda_inter, hidden width). lr .03 is very high for Adam: expect unstable training.
    """
    views = ViewAugment(grayscale=0.0) if phased else ViewAugment()
    return Run(recipe="paper", data=data, augment=Augment(vision=views, touch=views))


def authors(data: DatasetConfig, phased: bool) -> Run:
    """The settings of the authors' released code, without its defects.

    The code is https://github.com/ligerfotis/mvitac at commit a5b572d.

    Differences from `paper`: lr 1e-3 with weight decay 1e-6 and StepLR, which first decays at epoch 20; wide heads with
    dropout; a random first convolution for stacked gels; flips with an effective probability of 25 %; grayscale also for
    grasping; whole images are probed at 256 px. Not repeated: other views of the second gel of a stacked image, key heads
    that are never updated, key towers that do not start as copies of the query towers, the last short batch of an epoch, and
    the choice of a checkpoint by its last training batch: here the last epoch is kept.
    """
    views = ViewAugment(flip=0.25, grayscale=0.2)
    base = paper(data, phased)
    return replace(
        base,
        recipe="authors",
        method=MViTacConfig(hidden=2048, dropout=0.5),
        optim=Optim(lr=1e-3, eps=1e-8, weight_decay=1e-6, schedule="late-step"),
        encoder=base.encoder.changed(stem="random"),
        augment=replace(base.augment, whole=256, vision=views, touch=views),
    )


def modern(data: DatasetConfig, phased: bool) -> Run:
    """Current practice. The list gives the reason and the measured effect of each change, in points of accuracy.

    Unless noted, effects are measured in 300 steps of `quick`'s networks with momentum keys (docs/results/ablation.md).

    - End-to-end keys: gradients through both views instead of a momentum tower, as in SimCLR, and inter-modal losses on all
      pairs of views. With all steps of `quick`: 11 points of category, 12 of rough, and almost twice the retrieval score
      of momentum keys. Steps take 1.4 times as long (docs/results/materials.md). All pairs alone: no difference.
    - No flips of touch, which no real press shows: 4 points of category with all steps of `quick`.
    - AdamW with lr 1e-3, warm-up and cosine schedule (MoCo v3): Adam at a constant .03 destroys the ImageNet weights. Also
      from scratch, 8 points of category (one seed). Biases and BatchNorm are not decayed.
    - BatchNorm in the heads (SimCLR v2, MoCo v3) against an early collapse with small batches: no difference (three seeds).
    - Rows of a touch are spread over the epoch: consecutive frames are near-duplicates and wrong as negatives. No
      difference on simulated touches, which have no consecutive frames (one seed).
    - same-touch positives: two views of one image share lamp, background and sensor, which is enough to minimise L_vv and
      L_tt without the material. Another press of the same instance shares only the object: with momentum keys and all steps
      of `quick` 19 points of category, 7 of soft, 13 of rough. Not used for grasps, whose phases differ in the contact.
    - bf16 where the hardware computes it: emulated, it takes ten times as long. Scores do not differ (docs/speed.md).
    """
    base = paper(data, phased)
    return replace(
        base,
        recipe="modern",
        method=MViTacConfig(head_norm=True, keys="end-to-end", pairs="all"),
        optim=Optim(
            name="adamw", lr=1e-3, eps=1e-8, weight_decay=1e-4, decay_norms=False, schedule="cosine", warmup=0.05
        ),
        sampler="spread",
        positives="same-image" if phased else "same-touch",
        augment=replace(base.augment, touch=replace(base.augment.touch, flip=0.0)),
        precision="auto",
    )


def quick(data: DatasetConfig, phased: bool) -> Run:
    """`modern` for a laptop's CPU: ResNet-10 from scratch at 48 px, 1,350 steps of 32 pairs.

    `mvitac demo` trains it where ImageNet's weights are missing: 8 to 17 minutes on two cores without fast bf16.

    - ResNet-10 (timm's resnet10t) at 48 px: more steps in the same time. Crops show whole images at the scale of 72 px.
    - Batch 32, the number of steps and temperature .2 were chosen on split val, seed 0, never on test (docs/simulator.md).
    - Crops of at least 40 % of the area, no grayscale, lr 1.4e-3: easier views for few steps.
    - one-per-touch batches: all touch groups of simulated materials have the same size.
    - Momentum .9 for methods that have one (``with_method``): .99 would average over more steps than a short run has.
    """
    base = modern(data, phased)
    views = ViewAugment(scale=(0.4, 1.0), grayscale=0.0)
    return replace(
        base,
        recipe="quick",
        sampler="one-per-touch",
        method=MViTacConfig(head_norm=True, keys="end-to-end", pairs="all", momentum=0.9, temperature=0.2),
        optim=replace(base.optim, lr=1.4e-3),
        encoder=Encoders().changed(trunk="resnet10t", weights=SCRATCH),
        augment=Augment(size=48, whole=72, vision=views, touch=replace(views, flip=0.0)),
        batch_size=32,
        steps=1350,
        eval_every=500,
    )


def locked(data: DatasetConfig, phased: bool) -> Run:
    """`quick` with the camera's tower locked at ImageNet (arXiv:2111.07991): touch and the heads are trained.

    `mvitac demo` trains this recipe where the weights are installed. The features of the camera images are computed once,
    at 128 px, so that a step costs half of one of `quick`. From all stages of EfficientNet-Lite0 a linear probe names 69 %
    of the simulator's categories, from its last layer 59 %, and from that at the 72 px that are stored 50 % (split val).
    Touch starts from random weights: from ImageNet it loses fine texture. Its trunk is `quick`'s without the last stage,
    read from all its stages. Chosen on val, too: lambda_inter 2; and at 44 px instead of 48 a weight decay of 3 (900 steps:
    category by both 74.2, rough 92.6, R@5 27.0; of 1 70.7, 91.6, 25.8; of 1e-4 69.7, 89.3, 25.0; of 10 65.8, 85.9, 14.7).
    For `quick`, whose camera tower learns, too, a decay of 3 is wrong: 41.6 for 49.6, force 43.5 for 62.0.
    """
    base = quick(data, phased)
    whole = ViewAugment(scale=(1.0, 1.0), flip=0.0, grayscale=0.0, size=128)
    imagenet = EncoderConfig(trunk="tf_efficientnet_lite0", pool="stages", locked=True)
    return replace(
        base,
        recipe="locked",
        method=replace(base.method, lambda_inter=2.0),
        optim=replace(base.optim, weight_decay=3.0),
        encoder=Encoders(vision=imagenet, touch=EncoderConfig(trunk="mvitac_resnet8", weights=SCRATCH, pool="stages")),
        augment=replace(base.augment, size=44, whole=66, vision=whole),
        steps=800,
        eval_every=800,
    )


def smoke(data: DatasetConfig, phased: bool) -> Run:
    """`quick` in seconds, for tests: the paper's momentum keys, a tiny trunk at 32 px, 8 steps. Scores have no meaning."""
    base = quick(data, phased)
    return replace(
        base,
        recipe="smoke",
        encoder=Encoders().changed(trunk="mvitac_tiny", weights=SCRATCH),
        method=MViTacConfig(hidden=32, out=16),
        optim=replace(base.optim, lr=2e-3),
        augment=replace(base.augment, size=32, whole=None, touch=base.augment.vision),
        batch_size=16,
        steps=8,
        precision="fp32",
        log_every=2,
        eval_every=4,
    )


_ALL = (paper, authors, modern, quick, locked, smoke)
RECIPES: dict[str, Callable[[DatasetConfig, bool], Run]] = {f.__name__: f for f in _ALL}


def with_method(run: Run, method: str) -> Run:
    """Replace the method of ``run``, and keep what the run's recipe changed in fields that both methods have.

    A method that is compared with MViTac thus gets the head and the momentum that the recipe sets for its budget. Its other
    fields have the method's own defaults.
    """
    if method == run.method.name:
        return run
    old, new = default(MethodConfig, run.method.name), default(MethodConfig, method)
    common = {f.name for f in fields(old)} & {f.name for f in fields(new)}
    changed = {name for name in common if getattr(run.method, name) != getattr(old, name)}
    return replace(run, method=replace(new, **{name: getattr(run.method, name) for name in changed}))


def recipe(name: str, data: DatasetConfig | Pack | None = None, phased: bool | None = None) -> Run:
    """Return the named recipe as a ``Run``; ValueError if there is none of this name.

    Args:
        name: One of ``RECIPES``: paper, authors, modern, quick, locked, smoke.
        data: Dataset to train on, or an open pack. Default: simulated touches of materials, as in `mvitac demo`.
        phased: Whether rows of a touch group show the phases of a grasp. They are then not each other's positives, and
            views are not grayscale. Default: what the data says (``Pack.phased``), opened if needed.

    Examples:
        >>> recipe("quick").data.name
        'materials'
    """
    check_known("recipe", [name], RECIPES)
    if isinstance(data, Pack):
        phased = data.phased if phased is None else phased
        data = data.config or PackConfig(path=data.path)
    given: DatasetConfig = data or default(DatasetConfig, "materials")  # type: ignore[assignment]
    phased = given.phased if phased is None else phased
    return RECIPES[name](given, given.open(quiet=True).phased if phased is None else phased)
