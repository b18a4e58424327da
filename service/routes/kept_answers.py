"""Kept answers: read and delete."""

from __future__ import annotations

from fastapi import APIRouter, Response, status

from service.errors import InvalidRequestError, StoreUnavailableError, UnknownAnswerError
from service.http.problems import problem_responses
from service.http.uploads import JSON
from service.routes.dependencies import Running, Tenant, is_id
from service.schemas import LocaliseAnswer

router = APIRouter(prefix="/answers", tags=["localisation"])

_PROBLEMS = problem_responses(UnknownAnswerError, InvalidRequestError, StoreUnavailableError)


@router.get("/{answer_id}", summary="Get a kept answer", response_model=LocaliseAnswer, responses=_PROBLEMS)
def get_answer(answer_id: str, runtime: Running, tenant: Tenant) -> Response:
    """Return the answer to an earlier query, byte for byte, while it is kept. Panoramas are never kept."""
    kept_s = runtime.settings.storage.keep_answers_s
    content = runtime.store.answers.get(tenant, answer_id, kept_s=kept_s) if is_id(answer_id) else None
    if content is None:
        raise UnknownAnswerError(answer_id)
    return Response(content, media_type=JSON)


@router.delete(
    "/{answer_id}", status_code=status.HTTP_204_NO_CONTENT, summary="Delete a kept answer", responses=_PROBLEMS
)
def delete_answer(answer_id: str, runtime: Running, tenant: Tenant) -> None:
    """Delete a kept answer before it expires."""
    if not is_id(answer_id) or not runtime.store.answers.delete(tenant, answer_id):
        raise UnknownAnswerError(answer_id)
