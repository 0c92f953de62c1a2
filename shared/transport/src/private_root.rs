//! The folder in which all runs of a user keep their service files: nobody else can look into it or put anything there.
//!
//! | tried in turn | when |
//! |---|---|
//! | `$XDG_RUNTIME_DIR/delmpc`, `/run/user/UID/delmpc` | the folder above is a real one, this user's, closed to others |
//! | `$TMPDIR/delmpc-UID`, `/tmp/delmpc-UID` | otherwise; a path that is relative or too long is passed over |
//!
//! Folders for temporary files belong to everybody, and whoever comes first chooses what lies there. So the folder is opened without
//! following links, and owner and mode are asked of the opened folder, not of its name. What is not a plain folder of this user with
//! mode 0700 is refused, never used.

use std::fs::{DirBuilder, File, OpenOptions};
use std::hash::{DefaultHasher, Hash, Hasher};
use std::io::{self, ErrorKind, Read, Write};
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

use rustix::fs::{Mode, OFlags, open};
use rustix::process::geteuid;

use crate::LinkError;

/// Only its owner may do anything with it.
const PRIVATE: u32 = 0o700;
/// Permissions of anybody but the owner.
const OTHERS: u32 = 0o077;
/// iceoryx2 0.10 has room for paths of 255 bytes; the longest it makes in a run's folder is `/RUN/services/delmpc_RUN_HASH.service` with a
/// hash of 40 digits.
const LONGEST_ROOT: usize = 150;
/// Length of the user's secret.
const KEY: usize = 32;

/// The folder of this user for all runs, made if it is not there.
///
/// # Errors
/// [`LinkError::NotPrivate`] when something else lies there, [`LinkError::NoRuntimeFolder`] when it cannot be made.
pub fn runtime_folder() -> Result<PathBuf, LinkError> {
    let user = geteuid().as_raw();
    let given = std::env::var_os("XDG_RUNTIME_DIR").map(PathBuf::from);
    let usual = PathBuf::from(format!("/run/user/{user}"));
    for runtime in given.into_iter().chain([usual]) {
        let folder = runtime.join("delmpc");
        if fits(&folder) && open_private(&runtime).is_ok() && make(&folder).is_ok() {
            return Ok(folder);
        }
    }
    let temporary = std::env::var_os("TMPDIR")
        .map(PathBuf::from)
        .filter(|folder| fits(&folder.join("delmpc-4294967295")));
    let places = temporary.into_iter().chain([PathBuf::from("/tmp")]);
    let mut made =
        Err(LinkError::NotPrivate { folder: PathBuf::from("/tmp"), what: "it cannot be asked".to_owned() });
    for folder in places.map(|place| place.join(format!("delmpc-{user}"))) {
        made = make(&folder).map(|()| folder);
        if made.is_ok() {
            break;
        }
    }
    made
}

fn fits(folder: &Path) -> bool {
    folder.is_absolute() && folder.as_os_str().len() < LONGEST_ROOT
}

/// Makes the folder unless it is there, and makes sure that it is private.
fn make(folder: &Path) -> Result<(), LinkError> {
    let unusable = |source| LinkError::NoRuntimeFolder { folder: folder.to_owned(), source };
    match DirBuilder::new().mode(PRIVATE).create(folder) {
        Err(error) if error.kind() != ErrorKind::AlreadyExists => return Err(unusable(error)),
        _ => {}
    }
    open_private(folder).map(drop)
}

/// Opens a folder of this user that is closed to everybody else; no link is followed.
fn open_private(folder: &Path) -> Result<File, LinkError> {
    let refused = |what: String| LinkError::NotPrivate { folder: folder.to_owned(), what };
    let flags = OFlags::RDONLY | OFlags::DIRECTORY | OFlags::NOFOLLOW | OFlags::CLOEXEC;
    let opened = open(folder, flags, Mode::empty())
        .map_err(|error| refused(format!("it is no plain folder that we may open ({error})")))?;
    let opened = File::from(opened);
    let found = opened.metadata().map_err(|error| refused(error.to_string()))?;
    let user = geteuid().as_raw();
    if found.uid() != user {
        return Err(refused(format!("it belongs to user {}, we are user {user}", found.uid())));
    }
    if found.mode() & OTHERS != 0 {
        return Err(refused(format!(
            "its mode is {:04o}, others could put files there",
            found.mode() & 0o7777
        )));
    }
    Ok(opened)
}

/// A number that two processes of this user make alike from the same text, and that nobody else can guess: a hash of the text and of a
/// secret that lies in the private folder.
pub(crate) fn shared_number(text: &str) -> Result<u64, LinkError> {
    let folder = runtime_folder()?;
    let key = key(&folder).map_err(|source| LinkError::NoRuntimeFolder { folder, source })?;
    let mut hash = DefaultHasher::new();
    (key, text).hash(&mut hash);
    Ok(hash.finish())
}

/// The user's secret, made by whoever needs it first.
fn key(folder: &Path) -> io::Result<[u8; KEY]> {
    let path = folder.join("key");
    if let Ok(key) = read_key(&path) {
        return Ok(key);
    }
    // Written aside and moved, so that nobody reads half of it; the first one to arrive wins.
    let aside = folder.join(format!(".key-{}-{:016x}", std::process::id(), random_number()?));
    let mut key = [0; KEY];
    fill_randomly(&mut key)?;
    let written = OpenOptions::new().write(true).create_new(true).mode(0o600).open(&aside);
    written.and_then(|mut file| file.write_all(&key))?;
    let moved = std::fs::hard_link(&aside, &path);
    std::fs::remove_file(&aside)?;
    match moved {
        Err(error) if error.kind() != ErrorKind::AlreadyExists => Err(error),
        _ => read_key(&path),
    }
}

fn read_key(path: &Path) -> io::Result<[u8; KEY]> {
    let flags = (OFlags::NOFOLLOW | OFlags::NONBLOCK).bits() as i32;
    let mut file = OpenOptions::new().read(true).custom_flags(flags).open(path)?;
    let mut key = [0; KEY];
    file.read_exact(&mut key)?;
    Ok(key)
}

/// A number nobody can guess.
pub(crate) fn random_number() -> io::Result<u64> {
    let mut bytes = [0; 8];
    fill_randomly(&mut bytes)?;
    Ok(u64::from_ne_bytes(bytes))
}

/// Takes bytes from the operating system's generator.
fn fill_randomly(bytes: &mut [u8]) -> io::Result<()> {
    File::open("/dev/urandom")?.read_exact(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;
    use std::os::unix::fs::{PermissionsExt, symlink};

    fn scratch(name: &str) -> PathBuf {
        let folder = std::env::temp_dir().join(format!("delmpc-root-test-{}-{name}", std::process::id()));
        let _ = fs::remove_dir_all(&folder);
        fs::create_dir(&folder).unwrap();
        folder
    }

    #[test]
    fn a_folder_that_is_a_link_open_to_others_or_no_folder_is_refused() {
        let scratch = scratch("refused");
        let folder = scratch.join("delmpc");
        make(&folder).unwrap();
        make(&folder).unwrap();
        assert_eq!(fs::metadata(&folder).unwrap().permissions().mode() & 0o7777, PRIVATE);

        fs::set_permissions(&folder, fs::Permissions::from_mode(0o755)).unwrap();
        let error = make(&folder).unwrap_err().to_string();
        assert!(error.contains("0755") && error.contains("delmpc"), "{error}");
        fs::remove_dir(&folder).unwrap();

        fs::create_dir(scratch.join("theirs")).unwrap();
        symlink(scratch.join("theirs"), &folder).unwrap();
        assert!(matches!(make(&folder), Err(LinkError::NotPrivate { .. })));
        fs::remove_file(&folder).unwrap();

        fs::write(&folder, "").unwrap();
        assert!(matches!(make(&folder), Err(LinkError::NotPrivate { .. })));
        fs::remove_dir_all(&scratch).unwrap();
    }

    #[test]
    fn the_secret_stays_and_makes_numbers_that_differ_by_text() {
        let scratch = scratch("secret");
        let first = key(&scratch).unwrap();
        assert_eq!(key(&scratch).unwrap(), first);
        assert_ne!(first, [0; KEY]);
        assert_eq!(fs::metadata(scratch.join("key")).unwrap().permissions().mode() & 0o7777, 0o600);
        assert_eq!(fs::read_dir(&scratch).unwrap().count(), 1);
        fs::remove_dir_all(&scratch).unwrap();
    }
}
