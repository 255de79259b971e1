"""Classifiers fitted on frozen features: logistic regression, the paper's linear layer, k nearest neighbours.

Shapes: features [N, D]. A fitted classifier is a function from features to class probabilities [N, K].
"""

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
import torch
import torch.nn.functional as F
from sklearn.exceptions import ConvergenceWarning
from sklearn.linear_model import LogisticRegression
from threadpoolctl import ThreadpoolController
from torch import Tensor

Classifier = Callable[[np.ndarray], np.ndarray]

UNSEEN = -1e4  # logit of a class without training examples: probability 0 in fp32, and still finite in fp16
STRENGTHS = (0.001, 0.01, 0.1, 1.0)  # candidate values of C, the inverse regularisation strength of logistic regression
NEIGHBOURS = 20
_THREADPOOLS = cache(ThreadpoolController)  # finding them takes 5 ms, a tenth of a small probe's time
EPOCHS, BATCH, DROPOUT = 60, 256, 0.2  # training settings of the paper's probe (appendix A)


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Fit with one thread of BLAS, without scikit-learn's warnings that 300 steps are few: they choose C.

    Their products are small: waiting threads made logistic regression ten times slower. Several fits may run at once in
    threads, which torch counts by OpenMP: it has no limit. Both settings are the process's: who starts threads enters first.
    """
    with warnings.catch_warnings(), _THREADPOOLS().limit(limits=1, user_api="blas"):
        warnings.simplefilter("ignore", ConvergenceWarning)
        warnings.filterwarnings("ignore", "The number of unique classes")  # of few labels
        yield


@dataclass(frozen=True)
class Logistic:
    """Logistic regression on standardised features: [N, D] to probabilities [N, K], 0 for classes it was not fitted on."""

    model: LogisticRegression
    mean: np.ndarray
    std: np.ndarray
    num_classes: int

    def __call__(self, z: np.ndarray) -> np.ndarray:
        found = np.zeros((len(z), self.num_classes))
        found[:, self.model.classes_] = self.model.predict_proba((z - self.mean) / self.std)
        return found

    def weights(self) -> tuple[np.ndarray, np.ndarray]:
        """Weight [K, D] and bias [K] on features as they are: probabilities = softmax(features W^T + b)."""
        coef, intercept = np.asarray(self.model.coef_, float), np.asarray(self.model.intercept_, float)
        if len(coef) == 1:  # with two classes scikit-learn has one logit, that of the second class
            coef, intercept = np.concatenate([0 * coef, coef]), np.concatenate([0 * intercept, intercept])
        weight, bias = np.zeros((self.num_classes, coef.shape[1])), np.full(self.num_classes, UNSEEN)
        weight[self.model.classes_] = coef / self.std
        bias[self.model.classes_] = intercept - (coef / self.std) @ self.mean
        return weight, bias


@dataclass(frozen=True)
class Constant:
    """One class for all rows, where there was no other to learn from; as ``Logistic``."""

    label: int
    num_classes: int
    width: int  # D

    def __call__(self, z: np.ndarray) -> np.ndarray:
        return np.eye(self.num_classes)[np.full(len(z), self.label)]

    def weights(self) -> tuple[np.ndarray, np.ndarray]:
        bias = np.where(np.arange(self.num_classes) == self.label, 0.0, UNSEEN)
        return np.zeros((self.num_classes, self.width)), bias


def spread(x: np.ndarray) -> np.ndarray:
    """Standard deviation [D] of features [N, D] of any scale; 1 for those that vary by no more than rounding."""
    std = x.std(0, dtype=np.float64).astype(x.dtype)  # in float32 small squares are lost
    return np.where(std > 1e-6 * abs(x).max(0), std, std.dtype.type(1))


def fit_linear(
    x: np.ndarray, y: np.ndarray, x_val: np.ndarray, y_val: np.ndarray, num_classes: int = 0
) -> tuple[Logistic, float]:
    """Fit logistic regression on standardised features; returns the classifier and C.

    C is chosen on the validation rows; the final fit uses them, too. ``num_classes`` is K; 0 = up to the highest label.
    """
    mean, std = x.mean(0), spread(x)
    x, x_val = (x - mean) / std, (x_val - mean) / std
    # C ascends and each fit starts from the last one: about a third of the steps of cold starts.
    model = LogisticRegression(max_iter=300, tol=1e-3, warm_start=True)
    with one_blas_thread():
        c = STRENGTHS[int(np.argmax([model.set_params(C=c).fit(x, y).score(x_val, y_val) for c in STRENGTHS]))]
        if set(y_val) - set(y):  # a class seen only in val changes the shape of the weights
            model = LogisticRegression(max_iter=300, tol=1e-3)
        model.set_params(C=c).fit(np.concatenate([x, x_val]), np.concatenate([y, y_val]))
    return Logistic(model, mean, std, num_classes or int(max(y.max(), y_val.max())) + 1), c


def train_heads(features: Tensor, labels: Tensor, num_classes: Sequence[int], seed: int) -> list[Tensor]:
    """Train the paper's probe (appendix A): linear, dropout .2, Adam 1e-4 (eps 1e-7), 60 epochs, batch size 256.

    All tasks that share rows are trained at once. Adam updates each weight independently, so every head ends as if it were
    trained alone. ``seed`` sets the initial weights, the batch order and dropout. ``features`` [N, D] are on the device to
    train on; ``labels`` [T, N] of T tasks. Returns T weight matrices [num_classes, D + 1]; the last column is the bias.
    """
    (num, width), device = features.shape, features.device
    stream = torch.Generator(device).manual_seed(seed)
    # Initial weights depend on the seed alone, not on the other tasks.
    starts = [torch.rand(k, width, generator=torch.Generator().manual_seed(seed)) for k in num_classes]
    weight = ((torch.cat(starts) * 2 - 1) * width**-0.5).to(device).requires_grad_()
    bias = torch.zeros(sum(num_classes), device=device, requires_grad=True)
    optimiser = torch.optim.Adam([weight, bias], lr=1e-4, eps=1e-7, fused=device.type in ("cpu", "cuda"))
    labels = labels.to(device)
    for _ in range(EPOCHS):
        for batch in torch.randperm(num, generator=stream, device=device).split(BATCH):
            x = features[batch]
            keep = torch.rand(x.shape, generator=stream, device=device) >= DROPOUT
            logits = F.linear(x * keep / (1 - DROPOUT), weight, bias).split(list(num_classes), dim=1)
            losses = [F.cross_entropy(scores, labels[task][batch]) for task, scores in enumerate(logits)]
            optimiser.zero_grad()
            torch.stack(losses).sum().backward()
            optimiser.step()
    return list(torch.cat([weight.detach(), bias.detach()[:, None]], dim=1).cpu().split(list(num_classes)))


def fit_papers(x: np.ndarray, ys: list[np.ndarray], num_classes: list[int], seed: int) -> list[Classifier]:
    """Fit the paper's probe for several tasks on the same rows; returns one classifier per task."""
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    labels = torch.from_numpy(np.stack(ys)).long()
    heads = train_heads(torch.from_numpy(x).float().to(device), labels, num_classes, seed)

    def probabilities(z: np.ndarray, head: np.ndarray) -> np.ndarray:
        return np.asarray(torch.softmax(torch.from_numpy(z @ head[:, :-1].T + head[:, -1]), 1))

    return [partial(probabilities, head=head.numpy()) for head in heads]


def fit_knn(x: np.ndarray, y: np.ndarray, num_classes: int) -> Classifier:
    """Vote shares of the 20 nearest rows by cosine, with weight exp(cosine / .07) (arXiv:1805.01978, section 3.4)."""
    known, labels = F.normalize(torch.from_numpy(x).float(), dim=1), torch.from_numpy(y).long()

    def shares(z: np.ndarray) -> np.ndarray:
        near = (F.normalize(torch.from_numpy(z).float(), dim=1) @ known.T).topk(min(NEIGHBOURS, len(known)), dim=1)
        votes = torch.zeros(len(z), num_classes).scatter_add_(1, labels[near.indices], (near.values / 0.07).exp())
        return (votes / votes.sum(1, keepdim=True)).numpy()

    return shares
