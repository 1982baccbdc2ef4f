//! Settings that had another name once: files of older versions are read under the names of today, and a `--set` of an old
//! name is answered with the new one.

use driml_machine::error::{Usage, usage};
use toml::{Table, Value};

/// Table, old key and new key.
const RENAMED: &[(&str, &str, &str)] = &[("learner", "batch_rows", "batch_size")];

/// Gives the settings of an older version the names of today. A file with both names keeps both, for its reader to refuse the
/// old one.
pub fn update(settings: &mut Table) {
    for (table, old, new) in RENAMED {
        if let Some(table) = settings.get_mut(*table).and_then(Value::as_table_mut)
            && !table.contains_key(*new)
            && let Some(value) = table.remove(*old)
        {
            table.insert((*new).into(), value);
        }
    }
}

/// Gives keys and overrides (`"table.key=value"`) in the JSON of an older version the names of today.
pub fn update_json(text: &str) -> String {
    RENAMED
        .iter()
        .fold(text.to_owned(), |text, (table, old, new)| {
            text.replace(&format!("\"{old}\":"), &format!("\"{new}\":"))
                .replace(&format!("\"{table}.{old}="), &format!("\"{table}.{new}="))
        })
}

/// Refuses a `--set` of a name that is no longer.
///
/// # Errors
/// Says the name of today.
pub(crate) fn refuse(path: &str) -> Result<(), Usage> {
    let mut all = RENAMED.iter();
    match all.find(|(table, old, _)| path == format!("{table}.{old}")) {
        Some((table, _, new)) => Err(usage!("{path} is called {table}.{new} now")),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_old_name_becomes_the_one_of_today_and_nothing_else_changes() {
        let read = |text: &str| text.parse::<Table>().unwrap();
        let mut old = read("[learner]\nbatch_rows = 64\nkept = 1\n[other]\nbatch_rows = 2");
        update(&mut old);
        let new = read("[learner]\nbatch_size = 64\nkept = 1\n[other]\nbatch_rows = 2");
        assert_eq!(old, new);
        let both = read("[learner]\nbatch_rows = 64\nbatch_size = 32");
        let mut updated = both.clone();
        update(&mut updated);
        assert_eq!(updated, both);
        update(&mut Table::new());

        assert_eq!(
            update_json(r#"{"sets": ["learner.batch_rows=64"], "batch_rows": 8}"#),
            r#"{"sets": ["learner.batch_size=64"], "batch_size": 8}"#
        );
        for text in [r#"["run.seed=3"]"#, r#""learner.batch_rows_of=3""#] {
            assert_eq!(update_json(text), text);
        }
    }

    #[test]
    fn a_set_of_an_old_name_is_told_the_new_one() {
        let said = refuse("learner.batch_rows").unwrap_err().to_string();
        assert_eq!(said, "learner.batch_rows is called learner.batch_size now");
        assert!(refuse("learner.batch_size").is_ok());
    }
}
