// Profiles of performers, as files and as the server keeps them.

import { saveFile } from "./util.js";

/** A file larger than this is no profile, bytes: what the server takes, too. */
const MOST_BYTES = 256 << 10;

/** @param {any} profile */
export function saveProfile(profile) {
  saveFile(`${profile.name || "rhytid-profile"}.json`, `${JSON.stringify(profile, null, 2)}\n`);
}

/**
 * @param {File} file
 * @returns {Promise<any>} rejects with an Error of one sentence
 */
export async function readProfile(file) {
  if (file.size > MOST_BYTES) throw new Error("the file is too large to be a profile");
  let profile;
  try {
    profile = JSON.parse(await file.text());
  } catch {
    throw new Error("the file is not JSON");
  }
  if (profile?.rhytid_profile !== 1) throw new Error("the file is not a profile of version 1");
  return profile;
}

/**
 * Names of the profiles that the server keeps, and whom they were made of.
 * @param {string} room where one of them is to be used
 * @returns {Promise<{name: string, source: string}[]>}
 */
export async function listProfiles(room) {
  const answer = await fetch(`/api/profiles?room=${room}`, { headers: headers() });
  if (!answer.ok) throw new Error(`the server answers ${answer.status}`);
  return (await answer.json()).profiles;
}
