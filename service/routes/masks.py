"""Mask parts of a form to stacks."""

from collections.abc import Sequence

from fastapi import UploadFile

from model.inference.mask_stack import MaskStack
from model.interruption import Check
from service.routes.dependencies import Services


def read_stacks(
    services: Services, masks: Sequence[UploadFile], labels: frozenset[int] | None, check: Check
) -> tuple[MaskStack, ...]:
    """The stacks of all parts in their order; the check is passed before each part."""
    stacks: list[MaskStack] = []
    for number, mask in enumerate(masks):
        check()
        stacks += services.read_mask(mask.file, f"mask[{number}]", labels)
    return tuple(stacks)
