/** QR code that opens the plan on a phone. The link has the plan's id, and a key only if the page's own link had it. */

import { encode } from "uqr";

import { key } from "../api";
import { button, h, s, show } from "../dom";

export class PhoneLink {
  private readonly code = h("div", { class: "qr" });
  private readonly link = h("a", {});
  private readonly warning = h("p", { class: "hint" });
  private readonly dialog: HTMLDialogElement = h(
    "dialog",
    { id: "phone-dialog", "aria-labelledby": "phone-title" },
    h("h2", { id: "phone-title" }, "Open this plan on a phone"),
    this.code,
    h("p", {}, this.link),
    this.warning,
    h(
      "div",
      { class: "ask" },
      button("Close", () => this.dialog.close()),
    ),
  );

  constructor() {
    document.body.append(this.dialog);
  }

  open(planId: string): void {
    const address = `${location.origin}${location.pathname}#plan=${planId}${key.inLinks()}`,
      { data, size } = encode(address, { border: 2 });
    const dark = data.flatMap((row, y) => row.flatMap((isDark, x) => (isDark ? [`M${x} ${y}h1v1h-1z`] : [])));
    show(
      this.code,
      s(
        "svg",
        { viewBox: `0 0 ${size} ${size}`, role: "img", "aria-label": "QR code of the link below" },
        s("rect", { class: "light", width: size, height: size }),
        s("path", { class: "dark", d: dark.join("") }),
      ),
    );
    this.link.href = this.link.textContent = address;
    this.code.hidden = this.link.hidden = /^(localhost|127\..*|0\.0\.0\.0|\[::1?\])$/.test(location.hostname);
    this.warning.textContent = this.link.hidden
      ? "Phones cannot reach this address: run `make serve-lan` (`lalaloc-service serve --lan`) and open its link."
      : key.inLinks() !== ""
        ? "Phones warn once of the certificate: choose Advanced and Proceed, on an iPhone Show Details and visit this website. The link has a key, which ends with this run of the service."
        : location.protocol === "https:"
          ? "The phone asks for an API key if the service needs one."
          : "Without HTTPS, phones do not allow the camera; a film can be chosen instead.";
    this.dialog.showModal();
  }
}
