/** API documentation at /docs: Swagger UI, with the API key of this tab. */

import { api, key } from "./api";
import { byId } from "./dom";
import { connectKeyDialog } from "./key_dialog";
import { attempt } from "./notices";

interface SwaggerUi {
  preauthorizeApiKey(scheme: string, value: string): void;
}

declare const SwaggerUIBundle: (options: Record<string, unknown>) => SwaggerUi;

connectKeyDialog();
void attempt(byId("docs-error"), async () => {
  const spec: unknown = await api.json("/openapi.json");
  const ui = SwaggerUIBundle({
    spec,
    dom_id: "#api",
    deepLinking: true,
    docExpansion: "list",
    validatorUrl: null,
    onComplete: () => {
      const given = key.get();
      if (given !== null) ui.preauthorizeApiKey("api_key", given);
    },
  });
});
