/** Made by types.mjs. */
declare module "image-types" {
    /** The version of images that the types are of. */
    export const VERSION: number;
    /** The types by their names. */
    export const TYPES: Record<string, import("./image").Type>;
    /** The rows of the state packet; `name[]`: one of several. */
    export const ROWS: string[];
}
