//! Errors of the operating system in plain words: the system's own text ends in a number and uses
//! terms of programmers.
use std::io;

/// Text of an error that follows the name of a file: "does not exist".
pub fn words(e: &io::Error) -> String {
    use io::ErrorKind as K;
    let known = match e.kind() {
        K::NotFound => "does not exist",
        K::PermissionDenied => "permission denied",
        K::IsADirectory => "is a folder, not a file",
        K::NotADirectory => "a part of its path is a file, not a folder",
        K::StorageFull => "the disk is full",
        K::QuotaExceeded => "your share of the disk is used up",
        K::FileTooLarge => "the file is larger than the limit",
        K::ReadOnlyFilesystem => "the file system is read-only",
        K::InvalidFilename => "the name is too long",
        K::AddrInUse => "another program has it",
        K::OutOfMemory => "no memory left",
        K::UnexpectedEof => "ends too early",
        _ => match e.raw_os_error().filter(|_| cfg!(unix)) {
            Some(TOO_MANY_IN_PROCESS | TOO_MANY_IN_SYSTEM) => "too many files are open",
            Some(INPUT_OUTPUT) => "the disk gives an error",
            Some(number) if number == LINK_CIRCLE => "its symbolic links lead in a circle",
            _ => return bare(&e.to_string()),
        },
    };
    known.to_owned()
}

/// Advice after a semicolon; empty where the kind of the error implies none.
pub(super) fn advice(e: &io::Error) -> &'static str {
    use io::ErrorKind as K;
    match e.kind() {
        K::StorageFull | K::QuotaExceeded => "; free some space there, or choose a folder on another disk",
        K::FileTooLarge => "; the file size limit (ulimit -f) is too small for this file",
        K::PermissionDenied | K::ReadOnlyFilesystem => "; choose a folder that you may write to",
        K::NotFound | K::NotADirectory | K::IsADirectory => "; check the name",
        K::InvalidFilename => "; give a shorter one",
        _ => match e.raw_os_error().filter(|_| cfg!(unix)) {
            Some(TOO_MANY_IN_PROCESS | TOO_MANY_IN_SYSTEM) => {
                "; end other programs, or raise the limit of open files (ulimit -n)"
            }
            Some(number) if number == LINK_CIRCLE => "; check the name",
            _ => "",
        },
    }
}

/// EMFILE, ENFILE, EIO and ELOOP of Unix, for which there is no stable [`io::ErrorKind`].
const TOO_MANY_IN_PROCESS: i32 = 24;
const TOO_MANY_IN_SYSTEM: i32 = 23;
const INPUT_OUTPUT: i32 = 5;
const LINK_CIRCLE: i32 = if cfg!(target_os = "linux") { 40 } else { 62 };

/// Text of the system without its number: "Broken pipe (os error 32)".
fn bare(text: &str) -> String {
    let end = text.find(" (os error ").unwrap_or(text.len());
    let mut letters = text[..end].chars();
    // "Broken pipe" follows a name here; "RIFF …" keeps its capitals.
    match (letters.next(), letters.clone().next()) {
        (Some(first), Some(second)) if end < text.len() && second.is_lowercase() => {
            first.to_lowercase().chain(letters).collect()
        }
        _ => text[..end].to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[cfg(target_os = "linux")]
    #[test]
    fn system_error_text_has_no_number() {
        // EPERM, ENOENT, EIO, EACCES, ENOTDIR, EISDIR, ENFILE, EMFILE, EFBIG, ENOSPC, EROFS, EPIPE,
        // ENAMETOOLONG, ELOOP, EADDRINUSE, EDQUOT.
        for number in [1, 2, 5, 13, 20, 21, 23, 24, 27, 28, 30, 32, 36, 40, 98, 122] {
            let error = io::Error::from_raw_os_error(number);
            let text = words(&error);
            assert!(!text.is_empty() && !text.contains("os error"), "{number}: {text}");
            assert!(text.starts_with(char::is_lowercase), "{number}: {text}");
            let mended = advice(&error).starts_with("; ");
            assert!(mended || [5, 32, 98].contains(&number), "{number}: {text}: no way out");
        }
        assert_eq!(words(&io::Error::from_raw_os_error(2)), "does not exist");
        assert_eq!(words(&io::Error::from_raw_os_error(32)), "broken pipe");
        assert_eq!(words(&io::Error::other("RIFF chunk (of 3)")), "RIFF chunk (of 3)");
    }
}
