import { ServiceError } from "./errors.js";

/** Wait; throw the reason of an abort meanwhile. */
export function pause(ms: number, signal?: AbortSignal | null): Promise<void> {
  return new Promise((resolve, reject) => {
    signal?.throwIfAborted();
    setTimeout(resolve, ms);
    signal?.addEventListener("abort", () => reject(signal.reason), { once: true });
  });
}

/** Send a request with XMLHttpRequest, which reports the progress of the upload, as fetch does not. */
export function upload(
  url: string,
  { method, headers, body, signal }: RequestInit & { headers: Headers; signal: AbortSignal },
  onProgress: (sentBytes: number, totalBytes: number) => void,
): Promise<Response> {
  return new Promise((resolve, reject) => {
    signal.throwIfAborted();
    const sending = new XMLHttpRequest();
    sending.open(method ?? "GET", url);
    sending.responseType = "blob";
    headers.forEach((value, name) => sending.setRequestHeader(name, value));
    sending.upload.onprogress = ({ loaded, total }) => onProgress(loaded, total);
    sending.onerror = () => reject(new TypeError("no answer"));
    sending.onload = () => {
      const lines = sending.getAllResponseHeaders().matchAll(/^([^:\s]+): (.*)$/gm);
      const answered = [...lines].map(([, name, value]): [string, string] => [name!, value!]);
      const { status, statusText } = sending,
        body = status === 204 || status === 304 ? null : sending.response;
      resolve(new Response(body, { status, statusText, headers: answered }));
    };
    sending.onabort = () => reject(signal.reason);
    signal.addEventListener("abort", () => sending.abort(), { once: true });
    sending.send(body as XMLHttpRequestBodyInit);
  });
}

export const NDJSON = "application/x-ndjson";

/** Step of an import, such as "reading texts"; `done` of `total` levels if it is about one of several. */
export type ImportStep = { step: string; done?: number; total?: number };

/** Read the steps of an import; return the answer in its last line as if it had come without them. */
export async function endOf(response: Response, onStep?: (step: ImportStep) => void): Promise<Response> {
  if (onStep === undefined || !response.headers.get("content-type")?.startsWith(NDJSON)) return response;
  for await (const line of linesOf(response)) {
    const { status, answer, problem, etag, retry_after_s: after, ...step } = JSON.parse(line);
    if (status !== undefined) {
      const headers = { ...(etag && { etag }), ...(after && { "retry-after": String(after) }) };
      return new Response(JSON.stringify(answer ?? problem), { status, headers });
    }
    onStep(step);
  }
  throw brokenOff();
}

const brokenOff = (): ServiceError =>
  new ServiceError(0, "The connection broke off", "Check that the service runs and the network works, then try again.");

/** Yield the lines of an answer as they arrive; a caller that stops early closes the connection. */
export async function* linesOf(response: Response): AsyncGenerator<string> {
  const reader = response.body!.pipeThrough(new TextDecoderStream()).getReader();
  const read = () => reader.read().catch((error) => Promise.reject(error instanceof TypeError ? brokenOff() : error));
  let text = "";
  try {
    for (let part = await read(); !part.done; part = await read()) {
      const lines = (text + part.value).split("\n");
      text = lines.pop()!;
      yield* lines;
    }
  } finally {
    await reader.cancel().catch(() => undefined);
  }
}
