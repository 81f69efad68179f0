"""Networks of the Hugging Face hub through ``transformers``, which is an extra: ``hub``.

They are read from the matcher's folder or the hub's cache. Nothing is fetched, and of all files
only safetensors are taken. Pairs go in as grey images; the processors of ``transformers`` are left
out, since they squeeze every image to 640×480 and cut positions down to whole pixels.
"""

from __future__ import annotations

from typing import Any

import torch
from safetensors import SafetensorError
from torch import Tensor, nn

from flowrect.matchers._images import grey_tensor, same_size
from flowrect.matchers._weights import Published
from flowrect.sample import Image


def load_published(model_class: Any, published: Published) -> nn.Module:
    """The network, in evaluation mode; UserError if its weights are absent or incomplete."""
    place = published.folder() or published.place.removeprefix("https://huggingface.co/")
    try:
        net, info = model_class.from_pretrained(
            place, local_files_only=True, use_safetensors=True, output_loading_info=True,
            dtype=torch.float32,
        )  # fmt: skip
    except (OSError, ValueError, RuntimeError, SafetensorError) as error:
        cached = published.folder() is None and isinstance(error, OSError)
        why = "nothing usable of it in the hub's cache" if cached else str(error).splitlines()[0]
        raise published.absent(f"{place}: {why}") from error
    if info["missing_keys"]:
        raise published.absent(f"{place} lacks {min(info['missing_keys'])}")
    loaded: nn.Module = net.eval().requires_grad_(False)
    return loaded


def pair_tensor(seen: list[Image], multiple: int) -> Tensor:
    """(1, 2, 3, H, W): both images in grey, padded to multiples; three equal channels."""
    pair = torch.stack(same_size([grey_tensor(x) for x in seen], multiple), dim=1)
    return pair.expand(-1, -1, 3, -1, -1)
