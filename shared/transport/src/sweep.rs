//! Removal of files by handles of their folders: a name that somebody changes meanwhile cannot lead it elsewhere.

use std::ffi::CString;
use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::path::Path;

use rustix::fs::{AtFlags, Dir, FileType, Mode, OFlags, Stat, open, openat, statat, unlinkat};
use rustix::io::Errno;
use rustix::process::geteuid;

/// Levels of folders that are looked into; a run has two.
const DEEPEST: u32 = 8;
const FOLDER: OFlags = OFlags::RDONLY.union(OFlags::DIRECTORY).union(OFlags::NOFOLLOW).union(OFlags::CLOEXEC);

/// Opens a folder that is no link; `None` when there is none.
pub(crate) fn open_folder(path: &Path) -> io::Result<Option<OwnedFd>> {
    match open(path, FOLDER, Mode::empty()) {
        Ok(folder) => Ok(Some(folder)),
        Err(Errno::NOENT | Errno::NOTDIR | Errno::LOOP) => Ok(None),
        Err(error) => Err(error.into()),
    }
}

/// Removes whatever has a name in a folder, with all that is in it; follows no link. Returns the number of files removed.
pub(crate) fn remove_all(folder: BorrowedFd<'_>, name: &str) -> io::Result<usize> {
    let name = CString::new(name)?;
    remove(folder, &name, DEEPEST)
}

fn remove(folder: BorrowedFd<'_>, name: &CString, depth: u32) -> io::Result<usize> {
    let found = match statat(folder, name, AtFlags::SYMLINK_NOFOLLOW) {
        Err(Errno::NOENT) => return Ok(0),
        found => found?,
    };
    if kind(&found) != FileType::Directory {
        return gone(unlinkat(folder, name, AtFlags::empty())).map(usize::from);
    }
    let mut removed = 0;
    if depth > 0 {
        // Somebody else may be at the same work.
        if let Some(inside) = still_there(openat(folder, name, FOLDER, Mode::empty()))? {
            for entry in names(inside.as_fd())? {
                removed += remove(inside.as_fd(), &entry, depth - 1)?;
            }
        }
    }
    gone(unlinkat(folder, name, AtFlags::REMOVEDIR))?;
    Ok(removed)
}

/// Removes what is neither a plain file nor a folder of this user: iceoryx2 makes no such thing, and opening it may block for ever.
pub(crate) fn remove_strange(folder: BorrowedFd<'_>) -> io::Result<()> {
    remove_strange_to(folder, DEEPEST)
}

fn remove_strange_to(folder: BorrowedFd<'_>, depth: u32) -> io::Result<()> {
    for name in names(folder)? {
        let Ok(found) = statat(folder, &name, AtFlags::SYMLINK_NOFOLLOW) else { continue };
        match kind(&found) {
            FileType::RegularFile if is_ours(&found) => {}
            FileType::Directory if is_ours(&found) && depth > 0 => {
                if let Some(inside) = still_there(openat(folder, &name, FOLDER, Mode::empty()))? {
                    remove_strange_to(inside.as_fd(), depth - 1)?;
                }
            }
            _ => {
                remove(folder, &name, DEEPEST)?;
            }
        }
    }
    Ok(())
}

/// Whether a name stands for a plain file of this user, and no link.
pub(crate) fn is_our_file(folder: BorrowedFd<'_>, name: &str) -> bool {
    let found = statat(folder, name, AtFlags::SYMLINK_NOFOLLOW);
    found.is_ok_and(|found| kind(&found) == FileType::RegularFile && is_ours(&found))
}

fn is_ours(found: &Stat) -> bool {
    found.st_uid == geteuid().as_raw()
}

fn kind(found: &Stat) -> FileType {
    FileType::from_raw_mode(found.st_mode)
}

fn names(folder: BorrowedFd<'_>) -> io::Result<Vec<CString>> {
    let mut names = Vec::new();
    for entry in Dir::read_from(folder)? {
        let name = entry?.file_name().to_owned();
        if name.as_bytes() != b"." && name.as_bytes() != b".." {
            names.push(name);
        }
    }
    Ok(names)
}

/// What was opened, unless it is gone by now.
fn still_there(opened: rustix::io::Result<OwnedFd>) -> io::Result<Option<OwnedFd>> {
    match opened {
        Ok(opened) => Ok(Some(opened)),
        Err(Errno::NOENT) => Ok(None),
        Err(error) => Err(error.into()),
    }
}

/// Whether it was there to be removed.
fn gone(removed: rustix::io::Result<()>) -> io::Result<bool> {
    match removed {
        Ok(()) => Ok(true),
        Err(Errno::NOENT) => Ok(false),
        Err(error) => Err(error.into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;
    use std::os::unix::fs::symlink;
    use std::path::PathBuf;

    fn scratch(name: &str) -> PathBuf {
        let folder = std::env::temp_dir().join(format!("delmpc-sweep-test-{}-{name}", std::process::id()));
        let _ = fs::remove_dir_all(&folder);
        fs::create_dir_all(&folder).unwrap();
        folder
    }

    fn fifo(path: &Path) {
        rustix::fs::mknodat(rustix::fs::CWD, path, FileType::Fifo, Mode::RUSR | Mode::WUSR, 0).unwrap();
    }

    #[test]
    fn links_are_removed_and_what_they_point_to_stays() {
        let scratch = scratch("links");
        let victim = scratch.join("victim");
        fs::create_dir(&victim).unwrap();
        fs::write(victim.join("precious"), "1").unwrap();
        let run = scratch.join("run");
        fs::create_dir(&run).unwrap();
        symlink(&victim, run.join("services")).unwrap();
        symlink(victim.join("precious"), run.join("file")).unwrap();
        fifo(&run.join("fifo"));
        let folder = open_folder(&scratch).unwrap().unwrap();
        assert_eq!(remove_all(folder.as_fd(), "run").unwrap(), 3);
        assert!(!run.exists() && victim.join("precious").exists());
        assert_eq!(remove_all(folder.as_fd(), "run").unwrap(), 0);

        symlink(&victim, &run).unwrap();
        assert!(open_folder(&run).unwrap().is_none());
        assert_eq!(remove_all(folder.as_fd(), "run").unwrap(), 1);
        assert!(victim.join("precious").exists());
        fs::remove_dir_all(&scratch).unwrap();
    }

    #[test]
    fn what_is_strange_goes_and_plain_files_stay() {
        let scratch = scratch("strange");
        fs::create_dir(scratch.join("nodes")).unwrap();
        fs::write(scratch.join("nodes/plain"), "").unwrap();
        fifo(&scratch.join("nodes/fifo"));
        symlink("/", scratch.join("services")).unwrap();
        let folder = open_folder(&scratch).unwrap().unwrap();
        remove_strange(folder.as_fd()).unwrap();
        assert!(scratch.join("nodes/plain").exists());
        assert!(!scratch.join("nodes/fifo").exists() && !scratch.join("services").is_symlink());
        assert!(is_our_file(folder.as_fd(), "nodes/plain") && !is_our_file(folder.as_fd(), "nodes"));
        fs::remove_dir_all(&scratch).unwrap();
    }
}
