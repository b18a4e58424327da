/**
 * OpenID Connect issuer for tests: `node issuer.mjs PORT < keys.json`, where keys.json is a JWKS with private keys.
 *
 * The client `robot` gets tokens by client credentials for the resource `https://lalaloc.example`; its scopes are those
 * that it asks for. Prints a line once it listens, and one per request of its discovery document or keys.
 */
import { readFileSync } from "node:fs";
import Provider from "oidc-provider";

const port = Number(process.argv[2]);
const issuer = `http://127.0.0.1:${port}`;
const jwks = JSON.parse(readFileSync(0, "utf-8"));
const scopes = ["metrics", "read", "localise", "write", "admin"].map((name) => `lalaloc:${name}`).join(" ");

const provider = new Provider(issuer, {
  jwks,
  clients: [
    {
      client_id: "robot",
      client_secret: "robot's secret",
      grant_types: ["client_credentials"],
      redirect_uris: [],
      response_types: [],
    },
  ],
  extraTokenClaims: async (_context, token) => ({ tenant: token.clientId === "robot" ? "acme" : undefined }),
  features: {
    devInteractions: { enabled: false },
    clientCredentials: { enabled: true },
    resourceIndicators: {
      enabled: true,
      getResourceServerInfo: async (_context, resource) => ({
        scope: scopes,
        audience: resource,
        accessTokenTTL: 600,
        accessTokenFormat: "jwt",
        jwt: { sign: { alg: jwks.keys[0].alg, kid: jwks.keys[0].kid } },
      }),
    },
  },
});
provider.use(async (context, next) => {
  await next();
  if (context.path.includes("openid-configuration") || context.path === "/jwks") {
    console.log(`fetched ${context.path}`);
  }
});
provider.listen(port, "127.0.0.1", () => console.log("ready"));
