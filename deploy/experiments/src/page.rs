//! The page that an experiment writes: claim, command, time, expected and actual results, differences.
//! The text is a minijinja template beside the experiment. All numbers come from the results, so that none can be stale.

use driml_machine::units::{count, rough_duration};
use indicatif::HumanCount;
use minijinja::{Environment, Error, ErrorKind, UndefinedBehavior, Value, context};

use crate::{
    flags::this_command_line,
    stats::{Spread, difference, interval, mean, verdict},
};

const SMOKE_WARNING: &str =
    "**This is the smoke length: it shows that everything works, and its numbers mean nothing.**";

/// Describes for a page the time that all pieces took together: `jobs` runs were made at a time, on a machine with `cores` cores if
/// that is known.
pub(crate) fn describe_time(seconds: f64, jobs: u32, cores: Option<u32>) -> String {
    let jobs = match jobs {
        1 => String::new(),
        jobs => format!(" of runs, {jobs} at once,"),
    };
    let time = format!("{}{jobs}", rough_duration(seconds));
    match cores {
        Some(cores) => format!("{time} on a machine with {}.", count(cores, "core")),
        None => format!("{}.", time.trim_end_matches(',')),
    }
}

/// Returns the page of `template` as Markdown, filled with `values`. `smoke` adds a warning that the numbers mean nothing. The command
/// is that of this process unless `values` has another.
/// Do not build `values` through JSON: it turns NaN into null, which a mean would silently leave out.
pub(crate) fn render_page(template: &str, values: Value, smoke: bool, time: &str) -> String {
    let values = context! {
        time,
        smoke => if smoke { SMOKE_WARNING } else { "" },
        ..context! { ..values, ..context! { command => this_command_line() } }
    };
    fill(template, &values).unwrap_or_else(|e| {
        panic!("the template of the page is built in, and a test fills it: {e:#}")
    })
}

/// Returns the list below "Results" of a page, for the terminal.
pub(crate) fn summary(page: &str) -> String {
    let list = page.split("**Results.**\n\n").nth(1).unwrap_or_default();
    list.split("\n\n").next().unwrap_or_default().to_owned() + "\n"
}

/// Fills `template` with `values`. Empty blocks are dropped. Fails if the template names a value that its experiment does not provide.
pub(crate) fn fill(template: &str, values: &Value) -> Result<String, Error> {
    let mut environment = Environment::new();
    environment.set_undefined_behavior(UndefinedBehavior::Strict);
    environment.set_trim_blocks(true);
    environment.set_lstrip_blocks(true);
    environment.add_function("figure", |stem: &str, caption: &str| {
        format!("![{stem}]({stem}.png)\n\n{caption} ([SVG]({stem}.svg))")
    });
    environment.add_filter("fixed", fixed);
    environment.add_filter("percent", |value: Value| {
        or_dash(&value, |it| format!("{:.1}%", 100.0 * it))
    });
    environment.add_filter("sci", |value: Value| {
        or_dash(&value, |it| format!("{it:.1e}"))
    });
    environment.add_filter("factor", |value: Value| {
        or_dash(&value, |it| format!("x{it:.2}"))
    });
    environment.add_filter("duration", |value: Value| or_dash(&value, rough_duration));
    environment.add_filter("thousands", |number: u64| HumanCount(number).to_string());
    environment.add_filter("counted", |number: u64, noun: &str| count(number, noun));
    environment.add_filter("mean", |list: Value| reduce(&list, mean));
    environment.add_filter("spread", |list: Value, decimals: Option<usize>| {
        reduce(&list, |all| mean_and_sd(all, decimals.unwrap_or(3), true))
    });
    environment.add_filter("mean_and_sd", |list: Value, decimals: usize| {
        reduce(&list, |all| mean_and_sd(all, decimals, false))
    });
    environment.add_filter("interval", |list: Value, decimals: Option<usize>| {
        let decimals = decimals.unwrap_or(2);
        reduce(&list, |all| Some(format!("{:.decimals$}", interval(all)?)))
    });
    environment.add_filter("minus", |to: Value, from: Value| {
        let (to, from) = (numbers_of(&to)?, numbers_of(&from)?);
        let found = difference(&from, &to).map(|it| format!("{it:+}"));
        Ok::<_, Error>(found.unwrap_or_else(|| "-".into()))
    });
    environment.add_filter("verdict", |to: Value, from: Value| {
        let (to, from) = (numbers_of(&to)?, numbers_of(&from)?);
        Ok::<_, Error>(verdict(&from, &to))
    });
    let text = environment.render_str(template, values)?;
    let blocks = text.split("\n\n").map(str::trim);
    let blocks: Vec<_> = blocks.filter(|block| !block.is_empty()).collect();
    Ok(blocks.join("\n\n") + "\n")
}

/// Formats a number times `unit` (1 by default) with fixed decimals.
fn fixed(value: Value, decimals: usize, unit: Option<f64>) -> Result<String, Error> {
    let unit = unit.unwrap_or(1.0);
    or_dash(&value, |it| format!("{:.decimals$}", it * unit))
}

/// Formats a number with `text`, or a dash for `None`. An undefined value is an error.
fn or_dash(value: &Value, text: impl Fn(f64) -> String) -> Result<String, Error> {
    match value.is_none() || value.as_str() == Some("-") {
        true => Ok("-".into()),
        false => f64::try_from(value.clone()).map(text),
    }
}

/// Returns the numbers of a list without the `None` entries, which are runs and seeds that lack the number.
fn numbers_of(list: &Value) -> Result<Vec<f64>, Error> {
    if list.is_undefined() {
        return Err(ErrorKind::UndefinedError.into());
    }
    let known = list.try_iter()?.filter(|it| !it.is_none());
    known.map(f64::try_from).collect()
}

fn reduce<T: Into<Value>>(list: &Value, f: impl Fn(&[f64]) -> Option<T>) -> Result<Value, Error> {
    Ok(f(&numbers_of(list)?).map_or_else(|| "-".into(), Into::into))
}

/// Formats the mean, and for several values the standard deviation: `in_words` or after "±".
fn mean_and_sd(values: &[f64], decimals: usize, in_words: bool) -> Option<String> {
    let spread = Spread::of(values.iter().copied())?;
    let [mean, sd] = [spread.mean, spread.sd].map(|it| format!("{it:.decimals$}"));
    Some(match (spread.count, in_words) {
        (1, false) => mean,
        (1, true) => format!("{mean} (one seed)"),
        (_, false) => format!("{mean} ± {sd}"),
        (count, true) => format!("{mean} (standard deviation {sd} over {count} seeds)"),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_has_its_parts_and_says_when_it_is_a_smoke_test() {
        let template = "# T\n\n{{ smoke }}\n\n**Command.** `{{ command }}`\n\n**Time.** {{ time }}\n\n**Results.**\n\n* {{ got }}\n{% for it in more %}\n\
                        * {{ it }}\n{% endfor %}\n{% if no %}\n* no\n{% endif %}\n\ns_{t+1}:\n\n{{ figure('fig', 'A ' ~ got) }}\n";
        let command = "driml experiment t";
        let values = context! { got => 0.5, more => ["1", "2"], no => false, command };
        let page = |smoke, jobs, cores| {
            let time = describe_time(130.0, jobs, cores);
            render_page(template, values.clone(), smoke, &time)
        };
        let text = page(true, 1, Some(64));
        for part in [
            "# T\n",
            "smoke length",
            "**Command.** `driml experiment t`",
            "**Time.** 2 min on a machine with 64 cores.\n",
            "**Results.**\n\n* 0.5\n* 1\n* 2\n\ns_{t+1}:\n\n",
            "![fig](fig.png)\n\nA 0.5 ([SVG](fig.svg))\n",
        ] {
            assert!(text.contains(part), "{part}\n{text}");
        }
        assert_eq!(summary(&text), "* 0.5\n* 1\n* 2\n");
        assert!(page(true, 2, None).contains("**Time.** 2 min of runs, 2 at once.\n"));
        let other = page(false, 2, Some(64));
        assert!(other.contains("**Time.** 2 min of runs, 2 at once, on"));
        assert!(!other.contains("smoke length"));
    }

    #[test]
    fn lists_of_numbers_become_what_a_page_says_of_them() {
        let values = context! {
            base => [0.0, 0.01, 0.02, 0.03], more => [1.0, 1.1, 1.2, 1.3],
            less => [-1.0, -1.1, -1.2, -1.3], nan => f64::NAN,
        };
        for (template, expected) in [
            ("{{ [1.0, 3.0] | mean_and_sd(2) }}", "2.00 ± 1.41"),
            ("{{ [1.0] | mean_and_sd(1) }}", "1.0"),
            ("{{ [1.0] | spread }}", "1.000 (one seed)"),
            (
                "{{ [1.0, 3.0] | spread(2) }}",
                "2.00 (standard deviation 1.41 over 2 seeds)",
            ),
            ("{{ [1.0] | interval }}", "1.00 (one seed)"),
            ("{{ [1.0] | length | counted('run') }}", "1 run"),
            ("{{ 1234567 | thousands }}", "1,234,567"),
            ("{{ [2.0] | mean | factor }}", "x2.00"),
            ("{{ [] | mean | sci }}", "-"),
            ("{{ [] | minus(base) }}{{ none | fixed(3) }}", "--"),
            ("{{ [1.0] | minus(base) }}", "+0.98 (one seed)"),
            ("{{ more | minus(base) }}", "+1.14 [+0.93, +1.34]"),
            ("{{ more | verdict(base) }}", ", better than its base"),
            ("{{ less | verdict(base) }}", ", worse than its base"),
            ("{{ [-1.0, 1.0, 0.0] | verdict(base) }}.", "."),
            ("{{ [1.0, nan] | mean | fixed(2) }}", "NaN"),
        ] {
            let filled = fill(template, &values).unwrap();
            assert_eq!(filled.trim_end(), expected, "{template}");
        }
    }

    #[test]
    fn a_name_without_a_value_is_a_mistake() {
        for template in [
            "{{ a }}",
            "{{ a | fixed(2) }}",
            "{{ a | mean }}",
            "{{ a | minus([]) }}",
        ] {
            assert!(fill(template, &context! {}).is_err(), "{template}");
        }
    }
}
