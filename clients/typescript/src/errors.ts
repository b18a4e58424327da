import type { components } from "../generated/api.js";

/** Error answer of the service, or no answer: then `status` is 0. */
export class ServiceError extends Error {
  constructor(
    readonly status: number,
    readonly title: string,
    readonly detail: string,
    readonly faults: components["schemas"]["Fault"][] = [],
    /** End of the problem's `type`, such as `unknown-floorplan`. */
    readonly slug = "",
    readonly retryAfterS: number | null = null,
    /** Levels of a plan file, of which the request must name one. */
    readonly levels: string[] = [],
    /** Id of the request in the service's log. */
    readonly requestId: string | null = null,
  ) {
    super(detail ? `${title}: ${detail}` : title);
  }

  /** Return the error of an answer, which a proxy may have sent without a problem document. */
  static async of(response: Response): Promise<ServiceError> {
    const after = Number(response.headers.get("retry-after")) || null,
      { status } = response;
    try {
      return ServiceError.from(await response.json(), after);
    } catch {
      return new ServiceError(status, `The service answered ${status}`, response.statusText, [], "", after);
    }
  }

  /** Return the error of a problem document, such as that of a photograph of a batch. */
  static from(problem: components["schemas"]["Problem"], retryAfterS: number | null = null): ServiceError {
    const { status, title, detail, errors, levels, request_id: id } = problem;
    const slug = String(problem.type).split(":").pop() ?? "";
    return new ServiceError(status, title, detail, errors ?? [], slug, retryAfterS, levels ?? [], id ?? null);
  }
}
