"""Mask parts of a form to stacks."""

from collections.abc import Sequence

from fastapi import UploadFile

from model.inference.mask_stack import MaskStack
from model.interruption import Check
from service import use_cases
from service.routes.dependencies import Services


def masks_of_form(
    services: Services, masks: Sequence[UploadFile], labels: frozenset[int] | None, check: Check
) -> tuple[MaskStack, ...]:
    """See `use_cases.stacks_of`."""
    files = (mask.file for mask in masks)
    return use_cases.stacks_of(services.read_mask, files, labels, services.settings.max_voxels, check)
