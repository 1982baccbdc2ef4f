//! `--set key=value`: one value of the settings, by its dotted path, and the values of a table by such paths.
//! Keys and types are checked against the existing settings; each component checks its own ranges.

use driml_machine::error::{Usage, did_you_mean, usage};
use driml_protocol::config::describe;
use toml::{Table, Value};

/// The largest number up to which a float represents every whole number exactly.
const WHOLE_MAX: f64 = (1u64 << 53) as f64;

#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Override {
    /// The dotted path.
    pub path: String,
    value: Value,
}

impl Override {
    /// Parses `key=value`; a value that is not TOML becomes a string.
    pub(crate) fn parse(text: &str) -> Result<Self, Usage> {
        let form = "--set takes table.key=value, such as learner.update.adam.lr=1e-4";
        let parts = text.split_once('=');
        let (path, value) = parts.ok_or_else(|| usage!("--set {text:?} has no '='; {form}"))?;
        let (path, value) = (path.trim(), value.trim());
        if path.split('.').any(|key| key.trim().is_empty()) {
            return Err(usage!("--set {text:?} has no key before '='; {form}"));
        }
        let read = format!("value = {value}").parse::<Table>();
        // A line break could add a second key.
        let read = read.ok().filter(|table| table.len() == 1);
        let read = read.and_then(|mut table| table.remove("value"));
        Ok(Self {
            path: path.to_owned(),
            value: read.unwrap_or_else(|| Value::String(value.to_owned())),
        })
    }

    /// Puts the value into `table`; returns whether the key is new.
    ///
    /// A new key is accepted in an existing table; the reader of that table decides whether the key is a setting.
    pub(crate) fn apply(&self, table: &mut Table) -> Result<bool, Usage> {
        let parent = self.path.rsplit_once('.').map(|(tables, _)| tables);
        let parent = parent.and_then(|tables| find(table, tables));
        if !parent.is_some_and(Value::is_table) {
            return Err(self.unknown_key(table));
        }
        let old = find(table, &self.path);
        let is_new = old.is_none();
        let value = match old {
            Some(old) => self.convert_to_type_of(old)?,
            None => as_whole(&self.value).unwrap_or_else(|| self.value.clone()),
        };
        insert(table, &self.path, value);
        Ok(is_new)
    }

    fn convert_to_type_of(&self, old: &Value) -> Result<Value, Usage> {
        match (old, &self.value) {
            (Value::Float(_), Value::Integer(whole)) => Ok(Value::Float(*whole as f64)),
            (old, new) if old.same_type(new) => Ok(new.clone()),
            (old, new) => (old.as_integer().and_then(|_| as_whole(new))).ok_or_else(|| {
                let is_list = new.as_str().map_or(new.is_array(), |it| it.contains(','));
                let hint = match is_list && !old.is_array() && !old.is_table() {
                    true => "; `driml sweep` makes a run for each of several values, separated by commas without brackets",
                    false => "",
                };
                usage!(
                    "--set {}={}: this setting takes {}, and \"{new}\" is {}{hint}",
                    self.path,
                    inline_text(new),
                    type_name(old),
                    type_name(new),
                    new = inline_text(new),
                )
            }),
        }
    }

    /// The error for an unknown key: the keys that exist, and the nearest one.
    pub(crate) fn unknown_key(&self, table: &Table) -> Usage {
        let mut known = table;
        let mut at = Vec::new();
        for name in self.path.split('.') {
            let Some(inner) = known.get(name).and_then(Value::as_table) else {
                break;
            };
            known = inner;
            at.push(name);
        }
        // Most often, the user means the same key in another table.
        let paths: Vec<_> = leaves(table).into_iter().map(|(path, _)| path).collect();
        let key = |path: &str| path.rsplit('.').next().map(str::to_owned);
        let elsewhere = paths.iter().filter(|path| key(path) == key(&self.path));
        let near = match elsewhere.min_by_key(|path| strsim::levenshtein(&self.path, path)) {
            Some(path) => format!(" (did you mean {path:?}?)"),
            None => did_you_mean(&self.path, paths.iter().map(String::as_str)),
        };
        let keys: Vec<_> = known.keys().map(String::as_str).collect();
        let place = match &at[..] {
            [] => "the settings have the tables".into(),
            at => format!("[{}] has", at.join(".")),
        };
        usage!(
            "there is no setting {:?}{near}; {place} {}",
            self.path,
            keys.join(", ")
        )
    }
}

/// A float without a fraction as an integer: a number of frames may be written as 1e6. Floats are exact whole numbers up to 2^53.
fn as_whole(value: &Value) -> Option<Value> {
    let is_whole = |it: &f64| it.fract() == 0.0 && it.abs() <= WHOLE_MAX;
    Some(Value::Integer(value.as_float().filter(is_whole)? as i64))
}

pub(crate) fn find<'a>(table: &'a Table, path: &str) -> Option<&'a Value> {
    match path.split_once('.') {
        None => table.get(path),
        Some((first, rest)) => find(table.get(first)?.as_table()?, rest),
    }
}

/// Writes a value and creates the tables on its path. Another value in place of such a table stays, for its reader to reject.
pub(crate) fn insert(table: &mut Table, path: &str, value: Value) {
    match path.split_once('.') {
        None => {
            table.insert(path.into(), value);
        }
        Some((first, rest)) => {
            let new = || Value::Table(Table::new());
            let inner = table.entry(first).or_insert_with(new);
            if let Some(inner) = inner.as_table_mut() {
                insert(inner, rest, value);
            }
        }
    }
}

pub(crate) fn remove(table: &mut Table, path: &str) -> Option<Value> {
    match path.split_once('.') {
        None => table.remove(path),
        Some((first, rest)) => remove(table.get_mut(first)?.as_table_mut()?, rest),
    }
}

pub(crate) fn insert_missing(table: &mut Table, path: &str, value: Value) {
    if find(table, path).is_none() {
        insert(table, path, value);
    }
}

/// All values that are not tables, with their dotted paths.
pub fn leaves(table: &Table) -> Vec<(String, &Value)> {
    let mut found = Vec::new();
    for (key, value) in table {
        match value {
            Value::Table(inner) => {
                let inner = leaves(inner).into_iter();
                found.extend(inner.map(|(path, value)| (format!("{key}.{path}"), value)));
            }
            _ => found.push((key.clone(), value)),
        }
    }
    found
}

/// Describes what is wrong with a table, with the known name that is nearest to an unknown one.
pub(crate) fn explain(error: &toml::de::Error) -> String {
    let text = describe(error);
    let known = text.split(", in `").next().unwrap_or_default();
    let mut names = known.split('`').skip(1).step_by(2);
    let unknown = names.next().filter(|_| text.starts_with("unknown "));
    let near = unknown.map_or(String::new(), |it| did_you_mean(it, names));
    text.replacen(", expected", &format!("{near}, expected"), 1)
}

fn type_name(value: &Value) -> &'static str {
    match value {
        Value::String(_) => "a word",
        Value::Integer(_) => "a whole number",
        Value::Float(_) => "a number",
        Value::Boolean(_) => "true or false",
        Value::Datetime(_) => "a date",
        Value::Array(_) => "a list in [ ]",
        Value::Table(_) => "a table in { }",
    }
}

/// A value on one line, strings without quotes.
pub(crate) fn inline_text(value: &Value) -> String {
    match value {
        Value::String(word) => word.clone(),
        other => other.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_set_cannot_bring_in_a_second_key() {
        let mut settings: Table = "[run]\nseed = 1\ntimeout = \"terminal\"".parse().unwrap();
        let mut set = |text| Override::parse(text).unwrap().apply(&mut settings);
        assert!(set("run.seed=1\nother = 2").is_err());
        assert_eq!(set("run.timeout = \"bootstrap\"").ok(), Some(false));
        assert_eq!(settings["run"]["timeout"], Value::from("bootstrap"));
        assert_eq!(settings["run"]["seed"], Value::Integer(1));
    }
}
