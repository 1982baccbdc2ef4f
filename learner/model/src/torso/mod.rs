//! The menu of torsos: each is a file here, and a line of `torsos!`. `impoola` is `impala` with another last layer.

mod impala;
pub(crate) mod interface;
mod nature;

use std::fmt;

use serde::{Deserialize, Serialize};

use self::interface::{TorsoKind, TorsoSettings};
use crate::error::{ModelError, Result};

/// Makes [`TorsoName`] from one line per torso.
macro_rules! torsos {
    ($($(#[$attribute:meta])* $Torso:ident = $kind:path;)+) => {
        /// The torso of a network: `model.torso`.
        #[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
        #[serde(rename_all = "lowercase")]
        pub enum TorsoName {
            $($(#[$attribute])* $Torso,)+
        }

        impl TorsoName {
            const ALL: &[Self] = &[$(Self::$Torso),+];

            pub(crate) fn kind(self) -> &'static TorsoKind {
                match self {
                    $(Self::$Torso => &$kind,)+
                }
            }
        }
    };
}

torsos! {
    /// The convolutions of `conv`. Source: Mnih et al. 2015.
    #[default]
    Nature = nature::NATURE;
    /// A residual network with a stage for each entry of `channels`. Source: Espeholt et al. 2018.
    Impala = impala::IMPALA;
    /// As `Impala`, but f4 reads the mean of f3 over its locations. Source: Trumpp et al. 2025.
    Impoola = impala::IMPOOLA;
}

impl TorsoName {
    /// Returns the settings that only other torsos use.
    pub fn settings_of_others(self) -> impl Iterator<Item = &'static str> {
        let all = Self::ALL.iter().flat_map(|it| it.kind().settings);
        all.copied()
            .filter(move |it| !self.kind().settings.contains(it))
    }

    /// Describes for the reader of a checkpoint how the convolutions are applied, and what the fully connected layer takes.
    pub fn describe(self) -> String {
        let kind = self.kind();
        format!("{}; torso.fc takes {}", kind.convolutions, kind.fc_input)
    }

    /// Checks that `settings` has what this torso needs and no setting of another torso.
    pub(crate) fn check_settings(self, settings: &TorsoSettings<'_>) -> Result<()> {
        let given = [
            ("conv", !settings.conv.is_empty()),
            ("channels", !settings.channels.is_empty()),
            ("scale_blocks", settings.scale_blocks),
        ];
        let known = self.kind().settings;
        let own = known[0];
        let others = Self::ALL.iter().filter(|it| it.kind().settings[0] != own);
        let others: Vec<_> = others.map(Self::to_string).collect();
        let way = format!("model.torso to {}", others.join(" or "));
        for (name, is_given) in given {
            if is_given && !known.contains(&name) {
                return Err(ModelError::Config(format!(
                    "torso = {self} is made of model.{own}, and model.{name} is given too: leave model.{name} out, or set {way}"
                )));
            }
            if !is_given && name == own {
                return Err(ModelError::Config(format!(
                    "{own} is empty, and torso = {self} is made of it: set model.{own}, or set {way}"
                )));
            }
        }
        Ok(())
    }
}

impl fmt::Display for TorsoName {
    /// Writes the name that settings use.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}
