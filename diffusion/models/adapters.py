"""Which LoRA each sample of a batch is computed with."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from torch import Tensor, nn


@contextmanager
def with_adapters(unet: nn.Module, names: Sequence[str | None]) -> Iterator[None]:
    """Give each sample of a batch its adapter within this context; then all is as before.

    In mixed batches each adapter sees all samples, and what it makes of others' is erased
    between its two layers. peft's own way picks samples by lists, which are uploaded in every
    layer: slower, and a CUDA graph cannot hold it.

    Args:
        unet: With LoRAs of peft, or none.
        names: One name per sample, or None for the base weights.
    """
    from peft.tuners.lora.layer import LoraLayer

    layers = [module for module in unet.modules() if isinstance(module, LoraLayer)]
    if not layers:
        yield
        return
    states = [(layer, layer.active_adapters, layer.disable_adapters) for layer in layers]
    # Both of peft's switches set these too, which would start or stop a training.
    trained = [(weight, weight.requires_grad) for weight in unet.parameters()]
    wanted = sorted({name for name in names if name is not None})

    def erase_others(name: str) -> Callable[[nn.Module, Any, Tensor], None]:
        others = [sample for sample, own in enumerate(names) if own != name]

        def erase(module: nn.Module, args: Any, reduced: Tensor) -> None:
            for sample in others:
                reduced[sample].zero_()

        return erase

    hooks = []
    try:
        for layer in layers:
            layer.enable_adapters(bool(wanted))
            layer.set_adapter(wanted)
            for name in wanted if len(set(names)) > 1 else ():
                if name in layer.lora_A:
                    hooks.append(layer.lora_A[name].register_forward_hook(erase_others(name)))
        yield
    finally:
        for hook in hooks:
            hook.remove()
        for layer, active, disabled in states:
            layer.set_adapter(active)
            layer.enable_adapters(not disabled)
        for weight, flag in trained:
            weight.requires_grad_(flag)
