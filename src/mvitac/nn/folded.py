"""Frozen networks for the features of many images on a CPU: BatchNorm is part of the convolution before it.

Each BatchNorm is one more pass over memory, and a pass takes as long as many a convolution (docs/speed.md).
"""

import copy
from itertools import pairwise

from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval


def folded(network: nn.Module) -> nn.Module:
    """A copy of ``network``, which is in eval mode, without the BatchNorms that follow a convolution.

    What follows is read from the order of its modules. It may call them in another: compare the features of both.
    """
    if not any(isinstance(module, nn.BatchNorm2d) for module in network.modules()):
        return network
    network = copy.deepcopy(network)
    for parent in [*network.modules()]:
        for (first, conv), (second, norm) in pairwise([*parent.named_children()]):
            if not isinstance(conv, nn.Conv2d) or not isinstance(norm, nn.BatchNorm2d):
                continue
            if norm.running_mean is not None and conv.out_channels == norm.num_features:
                setattr(parent, first, fuse_conv_bn_eval(conv, norm))
                setattr(parent, second, getattr(norm, "act", nn.Identity()))  # timm's norm has its activation
    return network
