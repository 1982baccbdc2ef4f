//! Quotes words of commands that a person may paste into a shell.

use std::path::Path;

/// Quotes a word for a shell if it needs quotes.
pub fn quoted(word: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_.,=:/".contains(c);
    match word.chars().all(plain) {
        true => word.to_owned(),
        false => format!("'{}'", word.replace('\'', r"'\''")),
    }
}

/// Quotes a path for a shell if it needs quotes.
pub fn quoted_path(path: &Path) -> String {
    quoted(&path.to_string_lossy())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_command_can_be_pasted() {
        for (word, expected) in [
            ("--set=a.b=1", "--set=a.b=1"),
            ("a=[1, 2]", "'a=[1, 2]'"),
            ("a='b c'", r"'a='\''b c'\'''"),
        ] {
            assert_eq!(quoted(word), expected);
        }
    }
}
