/** Files and folders that are chosen, or dropped on the page. */

const PICTURES = /^image\/(jpeg|png|webp|heic|heif)$/;
// Some systems do not know the type of phones' files.
const PHONE_FILES = /\.hei[cf]$/i;

/** Return true for a file that can be a photograph; empty and hidden ones are none. */
export const isPicture = ({ name, size, type }: File): boolean =>
  (PICTURES.test(type) || PHONE_FILES.test(name)) && size > 0 && !name.startsWith(".");

/** Return a key of a name by which files are in the order of the command line: digits count as numbers. */
export const nameKey = ({ name }: File): string => name.replace(/\d+/g, (digits) => `\0${digits.padStart(20, "0")}\0`);

/** Return files by their keys, letters by their codes. */
export const sorted = (files: File[], key: (file: File) => string): File[] =>
  [...files].sort((a, b) => (key(a) < key(b) ? -1 : Number(key(a) > key(b))));

/** Return files in the order of their times, if all have different ones, else of their names. */
export async function inOrder(files: File[]): Promise<File[]> {
  const times = new Map(await Promise.all(files.map(async (file) => [file, await takenAt(file)] as const)));
  const isTold = new Set(times.values()).size === files.length && ![...times.values()].includes("");
  return sorted(files, isTold ? (file) => times.get(file)! : nameKey);
}

/** Return the earliest time in the head of a file, its Exif metadata; empty without one. */
async function takenAt(file: File): Promise<string> {
  const head = new TextDecoder("latin1").decode(await file.slice(0, 65_536).arrayBuffer());
  return (head.match(/\d{4}:\d\d:\d\d \d\d:\d\d:\d\d/g) ?? []).sort()[0] ?? "";
}

/** Accept the files that are chosen in a field, at least one; the same can be chosen again. */
export function acceptChoice(field: HTMLInputElement, take: (files: File[]) => void): void {
  field.addEventListener("change", () => {
    const files = [...(field.files ?? [])];
    field.value = "";
    if (files.length > 0) take(files);
  });
}

/** Accept files, and the files of folders, dropped on an element. */
export function acceptDrops(target: HTMLElement, take: (files: File[]) => void): void {
  for (const name of ["dragenter", "dragover"]) {
    target.addEventListener(name, (event) => {
      if (!(event as DragEvent).dataTransfer?.types.includes("Files")) return;
      event.preventDefault();
      target.classList.add("dropping");
    });
  }
  target.addEventListener("dragleave", (event) => {
    if (!target.contains((event as DragEvent).relatedTarget as Node | null)) target.classList.remove("dropping");
  });
  target.addEventListener("drop", (event) => {
    event.preventDefault();
    target.classList.remove("dropping");
    const transfer = (event as DragEvent).dataTransfer;
    // Entries are only known while the event is handled.
    const entries = [...(transfer?.items ?? [])].map((item) => item.webkitGetAsEntry?.() ?? null);
    if (entries.some((entry) => entry?.isDirectory))
      void Promise.all(entries.map((entry) => (entry === null ? [] : filesOf(entry)))).then((all) => take(all.flat()));
    else take([...(transfer?.files ?? [])]);
  });
}

async function filesOf(entry: FileSystemEntry): Promise<File[]> {
  if (entry.isFile) return [await new Promise<File>((done, fail) => (entry as FileSystemFileEntry).file(done, fail))];
  const reader = (entry as FileSystemDirectoryEntry).createReader(),
    files: File[] = [];
  for (;;) {
    // A reader gives a part of the entries at a time.
    const entries = await new Promise<FileSystemEntry[]>((done, fail) => reader.readEntries(done, fail));
    if (entries.length === 0) return files;
    for (const each of entries) files.push(...(await filesOf(each)));
  }
}
