"""Kept answers: read and delete."""

from __future__ import annotations

from fastapi import APIRouter, Response, status

from service.errors import UnknownAnswerError
from service.http.problems import problem_responses
from service.http.uploads import JSON
from service.routes.dependencies import Call, is_id
from service.routes.descriptions import READ_ERRORS
from service.schemas import LocaliseAnswer

router = APIRouter(prefix="/answers", tags=["localisation"])

_PROBLEMS = problem_responses(UnknownAnswerError, *READ_ERRORS)


@router.get("/{answer_id}", summary="Get a kept answer", response_model=LocaliseAnswer, responses=_PROBLEMS)
def get_answer(answer_id: str, call: Call) -> Response:
    """Return the answer to an earlier query, byte for byte, while it is kept. Photographs are never kept."""
    kept_s = call.settings.storage.keep_answers_s
    content = call.store.answers.get(call.tenant, answer_id, kept_s=kept_s) if is_id(answer_id) else None
    if content is None:
        raise UnknownAnswerError(answer_id)
    return Response(content, media_type=JSON)


@router.delete(
    "/{answer_id}", status_code=status.HTTP_204_NO_CONTENT, summary="Delete a kept answer", responses=_PROBLEMS
)
def delete_answer(answer_id: str, call: Call) -> None:
    """Delete a kept answer before it expires."""
    if not is_id(answer_id) or not call.store.answers.delete(call.tenant, answer_id):
        raise UnknownAnswerError(answer_id)
