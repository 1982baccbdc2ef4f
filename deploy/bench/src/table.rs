//! Columns of text and numbers, aligned.
//! It knows no bench.

/// Rows as lines whose columns are aligned: to the left, or to the right for the columns in `right`.
pub(super) fn aligned(rows: &[Vec<String>], right: &[usize]) -> String {
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    let width_of = |column: usize| {
        let cells = rows.iter().filter_map(|row| row.get(column));
        cells.map(|cell| cell.chars().count()).max().unwrap_or(0)
    };
    let widths: Vec<_> = (0..columns).map(width_of).collect();
    let line = |row: &Vec<String>| {
        let cells = row.iter().enumerate().map(|(column, cell)| {
            let width = widths[column];
            match right.contains(&column) {
                true => format!("{cell:>width$}"),
                false => format!("{cell:<width$}"),
            }
        });
        let line = cells.collect::<Vec<_>>().join("  ");
        format!("{}\n", line.trim_end())
    };
    rows.iter().map(line).collect()
}

/// A number with three digits that matter, and all those before the point.
pub(super) fn number(value: f64) -> String {
    match value.abs() {
        size if size >= 100.0 => format!("{value:.0}"),
        size if size >= 10.0 => format!("{value:.1}"),
        size if size >= 1.0 || size == 0.0 => format!("{value:.2}"),
        _ => format!("{value:.3}"),
    }
}

#[cfg(test)]
mod tests {
    use expect_test::expect;

    use super::*;

    #[test]
    fn columns_are_aligned() {
        let rows = [["update", "5.25", "updates/s"], ["insert", "61000", "/s"]];
        let rows = rows.map(|row| row.map(String::from).to_vec());
        expect![[r#"
            update   5.25  updates/s
            insert  61000  /s
        "#]]
        .assert_eq(&aligned(&rows, &[1]));
        assert_eq!(aligned(&[], &[]), "");
    }

    #[test]
    fn numbers_have_the_digits_that_matter() {
        let texts = [0.0, 0.12345, 1.2345, 12.345, 123.45, 61_234.5].map(number);
        assert_eq!(texts, ["0.00", "0.123", "1.23", "12.3", "123", "61234"]);
    }
}
